"""What a scene is: meshes, cameras, lights, materials, shapes and motion, as frozen NumPy data that was checked."""
