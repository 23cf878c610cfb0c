"""Acceleration structures: their geometry, their builders, their queries, and the table of their names."""
