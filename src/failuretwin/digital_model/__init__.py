"""The digital model: a robot, its kinematics and servo loops, and how a healthy one errs."""
