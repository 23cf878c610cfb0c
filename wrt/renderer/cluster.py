"""Machines that share work: their installations, and the scheduler of a Dask cluster. Dask is imported at first use."""

import logging
import pkgutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from hashlib import sha256
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from wrt.core.errors import InputError
from wrt.core.settings import VERSION

if TYPE_CHECKING:
    from distributed import Client

CONNECT_SECONDS = 5.0  # time limit for reaching the scheduler
WORKER_SECONDS = 10.0  # time limit for the first worker to connect


def _code() -> str:
    """Return a digest of the source files of wrt and kernels: two checkouts of one version can differ in any line."""
    folders = [("", Path(__file__).parents[1]), *(("kernels/", Path(folder)) for folder in import_module("wrt.kernels").__path__)]
    files = {before + path.relative_to(folder).as_posix(): path.read_bytes()
             for before, folder in folders for path in folder.rglob("*") if path.suffix in (".py", ".h", ".cpp", ".cu")}
    return sha256(b"".join(name.encode() + sha256(files[name]).digest() for name in sorted(files))).hexdigest()[:16]


# What can change a bit of a result and must be equal on all machines that share work. It is read once, at import, because a file that
# changes later is not the code that runs. A minor version of Python can change arithmetic, as 3.12 changed the sum() of floats.
INSTALLED = {"wrt": VERSION, "Python": "{}.{}".format(*sys.version_info), "NumPy": np.__version__, "Warp": wp.__version__,
             "code of wrt": _code()}


def check_installed(worker: str, there: dict[str, str], here: dict[str, str] = INSTALLED) -> None:
    """Raise InputError if the installation `there`, of a worker, differs from the installation `here`."""
    differ = [f"{name} {there.get(name)} (here {value})" for name, value in here.items() if there.get(name) != value]
    if differ:
        raise InputError(f"worker {worker} has {'; '.join(differ)}", hint="install the same everywhere")


@contextmanager
def connected(address: str) -> "Iterator[Client]":
    """Yield a dask.distributed.Client of the scheduler at an address such as tcp://host:8786.

    Raises InputError if the scheduler does not answer or has no worker, or if a worker has a different installation."""
    try:
        from distributed import Client
    except ImportError:
        raise InputError("a cluster needs dask.distributed", hint="pip install 'wrt[cluster]'") from None
    for name in [name for name in logging.root.manager.loggerDict if name.split(".")[0] == "distributed"]:
        logging.getLogger(name).setLevel(logging.CRITICAL)  # InputError reports the errors
    try:
        client = Client(address, timeout=CONNECT_SECONDS, set_as_default=False)
    except Exception as error:  # if another program answers, the error can have any type
        raise InputError(f"no Dask scheduler at {address!r}: {error or f'no answer in {CONNECT_SECONDS:g} s'}") from error
    with client:
        check_workers(client)
        yield client


def check_workers(client: "Client") -> None:
    """Raise InputError if there is no worker, or if a worker lacks wrt or has a different installation than this process."""
    if client.asynchronous:
        raise InputError("is an asynchronous Client", argument="executor", hint="make one without asynchronous=True")
    where = client.scheduler.address  # type: ignore[union-attr]
    try:
        client.wait_for_workers(1, timeout=WORKER_SECONDS)
    except TimeoutError as error:
        raise InputError(f"no worker at {where}", hint=f"start some with `dask worker {where}`") from error
    # Workers without wrt can run `resolve_name`.
    for worker, found in client.run(pkgutil.resolve_name, "wrt.renderer.cluster:INSTALLED", on_error="return").items():
        if isinstance(found, BaseException):
            raise InputError(f"worker {worker} lacks this version of wrt ({found})", hint=f"install wrt {VERSION} on the worker")
        check_installed(worker, found)
