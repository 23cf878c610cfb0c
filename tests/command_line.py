"""Run `python -m wrt` within the test's process, and return its exit code, stdout and stderr."""

from __future__ import annotations

import contextlib
import io
import sys
import threading
from collections.abc import Iterator
from typing import NamedTuple
from unittest import mock

from wrt.cli import main as cli
from wrt.core.compiling import COMPILING

BOX_OBJ = """\
v -1 -1 -1
v 1 -1 -1
v 1 1 -1
v -1 1 -1
v -1 -1 1
v 1 -1 1
v 1 1 1
v -1 1 1
f 1 4 3 2
f 5 6 7 8
f 1 2 6 5
f 3 4 8 7
f 2 3 7 6
f 1 5 8 4
"""


class Result(NamedTuple):
    """The exit code, stdout and stderr of a command."""

    code: int
    out: str
    err: str

    @property
    def errors(self) -> list[str]:
        """The lines of stderr that begin with "error:"."""
        return [line for line in self.err.splitlines() if line.lower().startswith("error:")]


def wrt(*arguments: object) -> Result:
    """Run `python -m wrt ARGUMENTS`. Exceptions that main() does not catch, a user's traceback, pass through to the test."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.ExitStack() as stack:
        stack.enter_context(mock.patch.object(sys, "argv", ["wrt", *map(str, arguments)]))
        stack.enter_context(mock.patch.object(cli, "_leave", sys.exit))  # os._exit would end the tests
        stack.enter_context(contextlib.redirect_stdout(out))
        stack.enter_context(contextlib.redirect_stderr(err))
        try:
            cli.main()
        except SystemExit as error:
            code = error.code
    return Result(code if isinstance(code, int) else 0, out.getvalue(), without_compiling(err.getvalue()))


@contextlib.contextmanager
def largest_file(size: int) -> Iterator[None]:
    """Limit files to `size` bytes, which simulates a full disk: a write beyond the limit raises OSError.

    First wait for the compilations of earlier tests: LLVM ends the process when it cannot write.
    """
    import resource

    from wrt.renderer.prepare import PREPARING

    for thread in threading.enumerate():
        if thread.name.startswith(PREPARING):
            thread.join(300.0)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def without_compiling(err: str) -> str:
    """Return stderr without the line about compiling, which depends on the kernel cache."""
    return err.replace(f"{COMPILING}\n", "")
