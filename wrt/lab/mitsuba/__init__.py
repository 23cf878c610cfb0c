"""Comparison with Mitsuba 3: translate a scene, render it, compare time and error."""
