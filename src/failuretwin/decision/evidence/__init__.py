"""What runs show: of a healthy robot and of each motor, at rest and on the way."""
