"""The physics engine: the same robot as bodies, gears and servos in MuJoCo, a judge of the twin."""
