"""Scene files in TOML: tables, their checks, and the scene that they make."""
