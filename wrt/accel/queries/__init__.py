"""Queries of structures with rays and points.

A call of closest_hit with NumPy arrays on a CPU runs through these files: accelerator.py (arguments and result), rays.py (checks
of the rays), answers.py (arrays for the hits), world_ids.py (check of `world`), batches.py (launches on threads), and
kernels/wide/batch.py, which finds t.
"""
