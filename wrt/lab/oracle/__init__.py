"""Hits of rays in float64 and exact arithmetic, and the error bounds that float32 answers must keep."""
