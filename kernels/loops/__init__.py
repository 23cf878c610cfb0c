"""The two loops around the integrator's step: one ray at a time (CUDA, counted rays), and waves of samples (CPU)."""
