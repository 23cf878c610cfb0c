"""Queries of structures with rays and points.

A call of closest_hit with NumPy arrays on a CPU runs through these files:
- accelerator.py (arguments and result), arguments.py (shapes, the rays' worlds), rays.py (segments of the rays);
- answers.py (arrays for the hits), batches.py (launches on threads), and kernels/wide/batch.py finds t.
"""
