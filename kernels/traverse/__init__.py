"""The RT core's traversal units: one structure a file, and what they share."""
