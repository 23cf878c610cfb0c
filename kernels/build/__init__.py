"""Kernels of the builders of acceleration structures: lbvh, fit and shape run on any device, the others on the CPU."""
