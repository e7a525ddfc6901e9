"""How topics are delivered: what is kept for late listeners, what streams, and where only the newest counts."""

from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

KEPT = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)  # meshes: late listeners get them too
STREAM = QoSProfile(depth=10)
NEWEST = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)  # what came while busy is overwritten
