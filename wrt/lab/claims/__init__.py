"""Published claims about ray tracing hardware, repeated with exact counts: `python -m wrt bench claims`."""

from collections.abc import Sequence
from dataclasses import dataclass

from wrt.lab import Plan, option


@dataclass(frozen=True)
class Claims(Plan):
    """Repeat published claims about ray tracing hardware. By exact counts: the published number, wrt's, their ratio, and what differs.

    NAMES: claims; default: all. Without files, generated scenes stand in for the published ones."""

    COMMAND, STUDY = "bench claims", "wrt.lab.claims.claim"
    QUICK = {"side": 48, "names": ("ttp-nodes", "cwbvh")}
    names: Sequence[str] = option((), of=("claim", "wrt.lab.claims.claim:CLAIMS"))
    scene: Sequence[str] = option((), "Published scenes that you have, as bunny=FILE,sponza=FILE",
                                  check="wrt.lab.claims.scenes:scene_files")
    side: int = option(128, "Side of the square pictures, in pixels", (8, 1024))
