"""Tests of one ray against one box, triangle, sphere or other bounding volume: the test units of an RT core."""
