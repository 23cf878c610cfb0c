"""Structures that split space: uniform grid, octree, k-d tree, BSP tree."""
