"""The digital model: a robot, its kinematics and servo loops, and how a healthy one errs."""

DEFAULT_ROBOT = "armpi_fpv"
"""Robot of logs and commands that name none."""
