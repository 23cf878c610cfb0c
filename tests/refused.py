"""Expect an InputError, and check its fields instead of its sentence, so that a better message needs no change of tests."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any, TypeAlias

import pytest

from wrt.core.errors import InputError

Refusal: TypeAlias = tuple[Any, ...]  # positional arguments of `refused`, in a table of cases


@contextlib.contextmanager
def refused(argument: str | None = None, what: str = "", place: str | None = None, path: str | os.PathLike[str] | None = None,
            hint: str = "") -> Iterator[pytest.ExceptionInfo[InputError]]:
    """Expect an InputError whose field `argument` is `argument` (None: an error that names no argument).

    `what` and `hint` must occur in the fields of these names. `place` is the whole field; `path` is the whole field or a file name.
    None for `place` or `path`: the field is not checked.
    """
    with pytest.raises(InputError) as caught:
        yield caught
    error = caught.value
    found = {"argument": error.argument}
    if place is not None:
        found["place"] = error.place
    if path is not None:
        found["path"] = None if error.path is None else os.fspath(error.path)
        if os.fspath(path) == os.path.basename(path) and found["path"]:
            found["path"] = Path(found["path"]).name
    expected = {"argument": argument, "place": place, "path": None if path is None else os.fspath(path)}
    assert found == {name: expected[name] for name in found}, str(error)
    assert what in error.what and hint in (error.hint or ""), str(error)
