"""Queries of structures with rays and points.

A call of closest_hit with NumPy arrays on a CPU runs through these files:
- accelerator.py (arguments and result), rays.py (checks of the rays), world_ids.py (check of `world`);
- answers.py (arrays for the hits), batches.py (launches on threads), and kernels/wide/batch.py finds t.
"""
