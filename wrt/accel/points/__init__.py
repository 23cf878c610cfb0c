"""Queries of points: the closest surface, inside or outside."""
