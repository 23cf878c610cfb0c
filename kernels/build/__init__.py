"""Inner loops of the builders that run on the host."""
