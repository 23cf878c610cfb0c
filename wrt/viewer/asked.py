"""What browsers ask of a thread of its own: of each kind, only the latest is answered."""

import threading
from typing import Any


class Asked:
    """A queue with one place for each kind of question."""

    def __init__(self) -> None:
        self._waiting: dict[str, Any] = {}
        self._changed, self._closed = threading.Condition(), False

    def put(self, kind: str, what: Any) -> None:
        """Ask `what`, in place of an older question of this kind that waits."""
        with self._changed:
            self._waiting[kind] = what
            self._changed.notify()

    def take(self) -> dict[str, Any]:
        """Wait for questions and return them by kind; an empty dict after `close`."""
        with self._changed:
            self._changed.wait_for(lambda: self._waiting or self._closed)
            taken, self._waiting = {} if self._closed else self._waiting, {}
        return taken

    def close(self) -> None:
        """End `take`."""
        with self._changed:
            self._closed = True
            self._changed.notify()
