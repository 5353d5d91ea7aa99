"""The physics engine: a robot with its motors and gears in MuJoCo."""
