"""The two render loops around the integrator's step (kernels/shade/step.py): one ray at a time on CUDA, and waves of samples on the CPU."""
