"""A registry imports the entries that are used, and no others."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from tests.refused import refused
from wrt.core.registry import Registry


def test_entries_become_what_they_name() -> None:
    table: Registry[type] = Registry("number", {"fraction": "fractions:Fraction", "decimal": "decimal:Decimal"})
    from decimal import Decimal
    from fractions import Fraction

    assert list(table) == ["fraction", "decimal"] and "decimal" in table and len(table) == 2
    assert table["fraction"] is Fraction and table.get("decimal") is Decimal and table.get("float") is None
    assert list(table.values()) == [Fraction, Decimal]
    assert list(table.items()) == [("fraction", Fraction), ("decimal", Decimal)]
    with pytest.raises(KeyError):
        table["float"]
    table.check("decimal")
    with refused(what="no number 'float'", hint="fraction, decimal"):
        table.check("float")


def test_names_are_shown_whatever_was_imported() -> None:
    table: Registry[type] = Registry("number", {"fraction": "fractions:Fraction", "decimal": "decimal:Decimal"})
    before = repr(table)
    assert before == str(table) == "Registry(number: fraction, decimal)"
    assert table["decimal"] and repr(table) == before
    table["own"] = int
    assert repr(table) == "Registry(number: fraction, decimal, own)"


def test_installed_packages_add_rows_and_replace_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "more-1.0.dist-info").mkdir()
    (tmp_path / "more-1.0.dist-info" / "entry_points.txt").write_text(
        "[numbers]\nfraction = decimal:Decimal\nordinal = fractions:Fraction\n[letters]\na = fractions:Fraction\n")
    monkeypatch.syspath_prepend(tmp_path)
    from fractions import Fraction

    for ask in (lambda table: "ordinal" in table, len, lambda table: table["ordinal"], repr):
        table: Registry[type] = Registry("number", {"fraction": "fractions:Fraction"}, "numbers")
        assert ask(table) and list(table) == ["fraction", "ordinal"]
        assert table["fraction"] is table["ordinal"] is Fraction
    with refused(what="no number 'a'", hint="fraction, ordinal"):
        table.check("a")


def test_a_render_imports_only_its_own_structure() -> None:
    code = ("import sys, wrt; from wrt.scene.shapes import icosphere; wrt.build(icosphere(1)); "
            "print(*(name for name in sys.modules if name.startswith('wrt.')))")
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    loaded = done.stdout.split()
    assert "wrt.accel.bvh.wide" in loaded
    assert not {"wrt.accel.cells.bsp", "wrt.accel.cells.kdtree", "wrt.kernels.build.sbvh", "wrt.kernels.build.bsp"} & set(loaded)
