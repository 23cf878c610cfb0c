"""The package itself: names that are imported when they are first used."""

from __future__ import annotations

import gc
from collections.abc import Iterator

import pytest

import wrt


@pytest.fixture
def collector() -> Iterator[None]:
    """Whether Python collects garbage is as it was, afterwards."""
    collects = gc.isenabled()
    yield
    if collects:
        gc.enable()
    else:
        gc.disable()


@pytest.mark.parametrize("collects", [True, False])
def test_an_import_leaves_the_garbage_collector_as_it_was(collects: bool, collector: None,
                                                          monkeypatch: pytest.MonkeyPatch) -> None:
    seen = []

    def imported(module: str) -> str:
        seen.append(gc.isenabled())
        if module == "missing":
            raise ImportError(module)
        return module

    monkeypatch.setattr(wrt.importlib, "import_module", imported)
    (gc.enable if collects else gc.disable)()
    assert wrt._imported("some") == "some"
    assert gc.isenabled() is collects
    with pytest.raises(ImportError, match="missing"):
        wrt._imported("missing")
    assert gc.isenabled() is collects
    assert seen == [False, False]
