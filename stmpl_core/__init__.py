"""The core: bodies, layers, charts, contacts and the methods that solve them. Knows no ROS and no FEM."""
