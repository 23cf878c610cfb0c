"""Files to meshes and scenes."""
