"""The walk of one ray through a structure, step by step: as a list, a drawing, an animation and JSON."""
