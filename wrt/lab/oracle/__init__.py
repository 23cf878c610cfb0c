"""Exact hits of rays, and bounds on the errors of float32 hits."""
