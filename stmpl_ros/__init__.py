"""The ROS side: node, simulated devices, recorder and the stmpl command."""
