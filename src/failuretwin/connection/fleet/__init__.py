"""Messages of a fleet of robots, the broker that carries them, and the bridge that fills it."""
