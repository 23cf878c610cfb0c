"""Foundations of wrt: errors, checks of arguments, files, threads, interrupts, devices, arrays shared with other libraries."""

VERSION = "0.1.0"  # of wrt: pyproject.toml reads it here
