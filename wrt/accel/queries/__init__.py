"""Queries: rays and points that a structure is asked, and its answers."""
