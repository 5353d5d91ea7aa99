"""Data and knowledge: run sets, readers, storage, generation."""
