"""Device code that only the laboratory needs."""
