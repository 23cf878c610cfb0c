"""Settings that every part of wrt shares."""

import os

VERSION = "0.1.0"  # of wrt: pyproject.toml reads it here
DEFAULT_DEVICE = os.environ.get("WRT_DEVICE") or "cpu"  # of all functions and commands
block_dim = 64  # threads in a block on a GPU; changes the speed only, not hits and pixels
