"""Interactive views of a scene in a browser, and pictures in notebooks."""
