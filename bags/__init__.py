"""Recordings in MCAP that rosbag2 accepts: write, read, recover, replay and compare. Needs no ROS at run time."""
