"""Registration: where the base is for the sensor, the tool point, senses, zeros, and geometry."""
