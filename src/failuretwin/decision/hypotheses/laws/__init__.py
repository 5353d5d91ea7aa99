"""Laws of the fault modes: how a motor settles with a fault."""
