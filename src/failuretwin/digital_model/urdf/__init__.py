"""URDF files: their contents, their check, and the choice of the tool link."""
