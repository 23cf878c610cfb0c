"""Scenes as frozen, checked NumPy data: meshes, cameras, lights, materials, shapes and motion."""
