"""The command line called in this process, as a shell would see it."""

from __future__ import annotations

import contextlib
import io
import sys
import threading
from collections.abc import Iterator
from typing import NamedTuple
from unittest import mock

from wrt.cli import main as cli
from wrt.renderer.progress import COMPILING

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
    """What is left of a command: exit code, stdout, stderr."""

    code: int
    out: str
    err: str

    @property
    def errors(self) -> list[str]:
        """The lines of stderr that tell an error."""
        return [line for line in self.err.splitlines() if line.lower().startswith("error:")]


def wrt(*arguments: object) -> Result:
    """`python -m wrt arguments` without a new process. An exception that main() lets through goes on: it is a traceback."""
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
    """No file may become larger than this: what a full disk looks like from here (Python ignores the signal that goes with it).

    An error does not wait for the compiler, and LLVM ends the process where it cannot write: those of earlier tests come first.
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
    """stderr without the line that is there or not, as the kernel cache has it."""
    return err.replace(f"{COMPILING}\n", "")
