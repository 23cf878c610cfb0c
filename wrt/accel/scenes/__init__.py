"""Scenes: how meshes, scenes and their files become structures."""
