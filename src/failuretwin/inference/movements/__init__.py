"""What each movement says of the angles of the motors."""
