"""Links to robots: sources of readings and commands, and sinks for what is said and sent."""
