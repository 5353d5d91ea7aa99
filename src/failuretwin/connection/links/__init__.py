"""Links to robots: sources of readings and commands, and sinks for what is said and sent."""

ROS1, ROS2, ROSBRIDGE = "ros1", "ros2", "rosbridge"
NETWORKS = (ROS1, f"{ROS2}[://HOST[:PORT]]", f"{ROSBRIDGE}://HOST[:PORT]")
"""Names of networks, as users write them."""
