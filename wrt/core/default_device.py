"""Default device of all functions and commands."""

from __future__ import annotations

import os

DEFAULT_DEVICE = os.environ.get("WRT_DEVICE") or "cpu"
