"""Files to meshes and scenes: OBJ, PLY, STL, TOML and glTF."""
