"""The RT core's test units: one ray against one box, triangle, sphere or other bounding volume."""
