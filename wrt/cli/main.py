"""The command line: it parses arguments, calls wrt and prints results.

stdout is for data, stderr for messages. Exit code 1 means that `compare` or `devices --check` found more difference than allowed. Code 2
means a user's mistake, which one message describes. After an interrupt, the code is 128 plus the signal's number: 130 for Ctrl-C, 143
for SIGTERM, 129 for SIGHUP. It is 141 if the reader of stdout ends first. Each command function imports slow modules itself, so that
--help is fast.
"""

import atexit
import contextlib
import gc
import io
import os
import sys
from typing import NoReturn

import click

import wrt
from wrt.cli.common import Commands, say
from wrt.core.errors import InputError
from wrt.core.interrupts import Interrupted, exit_code, raise_on_termination
from wrt.core.packages import needed_by
from wrt.core.registry import Registry

# Name -> "module:function". The module is imported when the command runs or --help lists it.
COMMANDS: Registry[click.Command] = Registry("command", {
    "animate": "wrt.cli.render:animate",
    "bench": "wrt.cli.measure:bench",
    "build": "wrt.cli.files:build",
    "compare": "wrt.cli.files:compare",
    "compile": "wrt.cli.files:compile_kernels",
    "devices": "wrt.cli.measure:devices",
    "info": "wrt.cli.files:info",
    "inspect": "wrt.cli.measure:inspect",
    "profile": "wrt.cli.measure:profile",
    "render": "wrt.cli.render:render",
    "schema": "wrt.cli.files:schema",
    "stability": "wrt.cli.measure:stability",
    "validate": "wrt.cli.files:validate",
    "view": "wrt.cli.view:view",
    "walk": "wrt.cli.measure:walk",
    "whatif": "wrt.cli.measure:whatif",
}, "wrt.commands", click.Command)


GC_THRESHOLD = 500_000  # New objects between two garbage collections. Starting wrt makes 300,000 objects, which stay.
OUT_OF_MEMORY = ("can't start new thread", "Failed to allocate")  # RuntimeErrors of Python and of Warp begin so


@click.group(cls=Commands, commands=COMMANDS, context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110})
@click.version_option(wrt.__version__, message="wrt %(version)s")
def cli() -> None:
    """Whitted ray tracer on NVIDIA Warp."""


def main() -> None:
    """Run the command line. A user's mistake causes one message; Ctrl-C causes no traceback."""
    gc.set_threshold(GC_THRESHOLD)
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")  # a name that stdout cannot encode is no error
    raise_on_termination()
    try:
        with needed_by("this command"):
            code = cli(standalone_mode=False)
    except InputError as error:
        say(f"error: {error}")
        code = 2
    except click.ClickException as error:
        error.show()
        code = error.exit_code
    except OSError as error:  # for example a path too long for the system, or stdout on a full disk
        say(f"error: {error}")
        code = 2
    except (click.Abort, KeyboardInterrupt) as error:  # click raises Abort from KeyboardInterrupt
        cause = error.__cause__ if isinstance(error, click.Abort) else error
        code = exit_code(cause.number if isinstance(cause, Interrupted) else None)
        say("interrupted")
    except (MemoryError, RuntimeError) as error:
        if isinstance(error, RuntimeError) and not str(error).startswith(OUT_OF_MEMORY):
            raise
        say(f"error: not enough memory: {error}")
        code = 2
    except SystemExit as error:
        code = error.code
    monitoring = getattr(sys, "monitoring", None)  # used by profilers from Python 3.12 on, and by tools that measure coverage
    if sys.getprofile() or sys.gettrace() or (monitoring and any(map(monitoring.get_tool, range(6)))):
        sys.exit(code)  # a profiler writes its result at exit
    _leave(code if isinstance(code, int) else 1 if code else 0)


def _leave(code: int) -> NoReturn:
    """Exit at once, without waiting for threads that compile and without freeing objects. No file is left half written."""
    if not code:
        atexit._run_exitfuncs()
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(AttributeError, OSError, ValueError):  # closed, or on a full disk
            stream.flush()
    os._exit(code)
