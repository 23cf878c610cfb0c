"""Readers of mesh files and scene files."""
