"""Bounding volume hierarchies, binary and wide: builders, refits and costs."""
