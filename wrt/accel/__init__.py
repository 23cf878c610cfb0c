"""Acceleration structures: what they are built over, what they answer, the table of them, and the way to build one."""
