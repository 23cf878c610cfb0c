"""The command line: it parses, calls and prints; it knows nothing of rendering.

stdout is data, stderr is talk. Exit codes: 0; 1 where `compare` or `devices --check` finds more difference than allowed; 2 for a
user's mistake, with one message; 128 and the signal's number when interrupted: 130 by Ctrl-C, 143 by SIGTERM, 129 by SIGHUP.
Whatever takes long to import is imported by the command that needs it.
"""

from __future__ import annotations

import atexit
import contextlib
import gc
import io
import os
import sys
from typing import NoReturn

import click

import wrt
from wrt.cli.commands import COMMANDS
from wrt.cli.common import Commands, say
from wrt.core.errors import InputError
from wrt.core.interrupts import Interrupted, exit_code, raise_on_termination

GARBAGE_AT = 500_000  # new objects before Python looks for garbage: a start makes 300,000, and all of them stay
# In errors of Warp and Python that are no MemoryError: the system gave no thread, no array, no room for a library.
OUT_OF_MEMORY = ("can't start new thread", "Failed to allocate", "failed to map segment")


@click.group(cls=Commands, commands=COMMANDS, context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110})
@click.version_option(wrt.__version__, message="wrt %(version)s")
def cli() -> None:
    """A Whitted ray tracer on NVIDIA Warp."""


def main() -> None:
    """Entry point: one clear message for a user's mistake, and no traceback for Ctrl-C."""
    gc.set_threshold(GARBAGE_AT)
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")  # a name that stdout cannot encode is no reason to fail
    raise_on_termination()
    try:
        code = cli(standalone_mode=False)
    except InputError as error:
        say(f"error: {error}")
        code = 2
    except click.ClickException as error:
        error.show()
        code = error.exit_code
    except OSError as error:  # from outside of wrt: a path too long for the system, stdout on a full disk
        say(f"error: {error}")
        code = 2
    except (click.Abort, KeyboardInterrupt) as error:  # click makes the first of the second
        cause = error.__cause__ if isinstance(error, click.Abort) else error
        code = exit_code(cause.number if isinstance(cause, Interrupted) else None)
        say("interrupted")
    except (MemoryError, RuntimeError, ImportError) as error:  # click.Abort is a RuntimeError, too
        told = f"{error}: {error.__cause__}" if error.__cause__ else str(error)
        if not (isinstance(error, MemoryError) or any(words in told for words in OUT_OF_MEMORY)):
            raise
        say(f"error: not enough memory{': ' if told else ''}{told}")
        code = 2
    except SystemExit as error:
        code = error.code
    if sys.getprofile() or sys.gettrace():
        sys.exit(code)  # who measures Python writes what he has when it ends
    _leave(code if isinstance(code, int) else 1 if code else 0)


def _leave(code: int) -> NoReturn:
    """Exit without waiting for a thread that compiles, and without freeing one by one what the system frees at once. Nothing is
    lost by it: files are whole or were never there."""
    if not code:
        atexit._run_exitfuncs()
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(AttributeError, OSError, ValueError):  # closed, or on a full disk
            stream.flush()
    os._exit(code)
