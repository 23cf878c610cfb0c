"""A look around in a scene: in a browser and in notebooks."""
