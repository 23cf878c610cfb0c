"""A running render in a notebook: the picture so far, in place."""

from __future__ import annotations

import base64
import html
import time
from typing import Any

from wrt.errors import InputError
from wrt.options import Progress
from wrt.progress import COMPILING, describe

SHARE = 0.1  # of the time, at most, that showing takes from rendering


class LiveView:
    """A callback for `wrt.render(scene, progress=wrt.LiveView())`: shows the picture so far and how far it is in the output of
    the cell, and the finished picture in the end. Interrupting the kernel ends the render, which returns what it has.

    every: seconds between two pictures, and more where showing one takes long (SHARE). Raises InputError where there is no
    IPython.
    """

    def __init__(self, every: float = 0.5) -> None:
        try:
            from IPython.display import HTML, display
        except ImportError:
            raise InputError("LiveView shows pictures in a notebook: IPython is not installed") from None
        self._html, self._display = HTML, display
        self.every = every
        self._due = 0.0
        self._handle: Any = None

    def __call__(self, progress: Progress) -> None:
        begin = time.monotonic()
        done = progress.picture is not None and progress.done == progress.total
        if begin < self._due and not done:
            return
        self._show(progress)
        now = time.monotonic()
        self._due = now + max(self.every, (now - begin) / SHARE)

    def _show(self, progress: Progress) -> None:
        if progress.stage == "compile":
            text = COMPILING
        else:
            text = f"{progress.done / max(progress.total, 1):.0%} {'' if progress.picture else progress.stage} {describe(progress)}"
        page = f"<pre>{html.escape(text)}</pre>"
        if progress.picture is not None:
            picture = base64.b64encode(progress.picture()._repr_png_()).decode()
            page = f'<img src="data:image/png;base64,{picture}" alt="the picture so far">' + page
        if self._handle is None:
            self._handle = self._display(self._html(page), display_id=True)
        else:
            self._handle.update(self._html(page))
