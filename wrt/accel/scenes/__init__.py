"""Conversion of meshes, scenes and their files to acceleration structures."""
