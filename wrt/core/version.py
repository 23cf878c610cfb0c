"""The version of wrt: pyproject.toml reads it here."""

VERSION = "0.1.0"
