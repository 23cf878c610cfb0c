"""The RT core's test units: a ray against a box, a triangle, a sphere, and other bounding volumes."""
