"""Default device of all functions and commands."""

import os

DEFAULT_DEVICE = os.environ.get("WRT_DEVICE") or "cpu"
