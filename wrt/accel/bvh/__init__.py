"""Bounding volume hierarchies: binary and wide, their builders, refit and measures."""
