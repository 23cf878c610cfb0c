"""Traversal of acceleration structures for one ray: one structure per file, and common parts."""
