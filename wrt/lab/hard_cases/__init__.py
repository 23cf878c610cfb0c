"""Rays that are hard to get right, and who gets them right."""
