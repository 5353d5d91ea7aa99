"""ROS bags and MCAP files, read without ROS."""
