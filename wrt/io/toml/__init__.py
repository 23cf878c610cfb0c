"""Scene files in TOML: their tables, checks, and conversion to a scene."""
