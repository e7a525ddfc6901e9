"""The ROS side: node, simulated devices, recorder and the stmpl command."""

import os
import sys

# A ROS installation sets this; ROS from wheels lies in the environment's own prefix.
os.environ.setdefault("AMENT_PREFIX_PATH", sys.prefix)
