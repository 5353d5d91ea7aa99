"""ROS 1: a node that listens to a robot, and one that plays a robot or reports on it."""
