"""Settings that every part of wrt shares."""

import os

DEFAULT_DEVICE = os.environ.get("WRT_DEVICE") or "cpu"  # of all functions and commands
block_dim = 64  # threads in a block on a GPU; changes the speed only, not hits and pixels
