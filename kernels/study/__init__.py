"""Device code of the laboratory alone."""
