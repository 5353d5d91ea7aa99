"""Recovery of the commands of published runs from their tool paths."""
