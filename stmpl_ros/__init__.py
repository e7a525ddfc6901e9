"""The ROS side: node, simulated devices, recorder and the stmpl command."""

import os
import signal
import sys

_IS_COMMAND = "".join(sys.argv[:1]).rpartition("/")[2] == "stmpl"
if _IS_COMMAND and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # until the command's `main` hears Ctrl-C: no traceback of imports

# A ROS installation sets this; ROS from wheels lies in the environment's own prefix.
os.environ.setdefault("AMENT_PREFIX_PATH", sys.prefix)
