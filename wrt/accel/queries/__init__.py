"""Queries: rays and points that a structure is asked, and its answers.

On the way of closest_hit with NumPy arrays, on a CPU, are five files of these: accelerator.py (arguments and result), rays.py
(checks of the rays), answers.py (arrays for the hits), world_ids.py (nothing, over one world), batches.py (launches over threads).
Then kernels/wide/batch.py finds t.
"""
