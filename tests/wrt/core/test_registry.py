"""A registry imports the entries that are used, and no others."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.data import ROOT
from tests.refused import refused
from wrt.core.errors import SceneWarning
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


@pytest.fixture
def broken(tmp_path: Path) -> Path:
    """A folder with a package, each of whose entry points is broken in another way but one of each group."""
    info = tmp_path / "odd_things-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: odd-things\nVersion: 1.0\n")
    rows = {"raises": "odd_raises:x", "exits": "odd_exits:x", "missing": "odd_module_that_is_missing:x", "absent": "odd:x",
            "no_colon": "odd", "number": "odd:number"}
    good = {"wrt.commands": "odd:command", "wrt.benches": "odd:command", "wrt.structures": "wrt.accel.brute_force:BruteForce"}
    (info / "entry_points.txt").write_text("".join(f"[{group}]\n" + "".join(
        f"{name} = {value}\n" for name, value in {**rows, "good": value}.items()) for group, value in good.items()))
    (tmp_path / "odd_raises.py").write_text('raise RuntimeError("boom\\nbang")\n')
    (tmp_path / "odd_exits.py").write_text("raise SystemExit(3)\n")
    (tmp_path / "odd.py").write_text('import click\nnumber = 3\n@click.command(help="It works.")\ndef command(): print("good")\n')
    return tmp_path


BROKEN = {"raises": "RuntimeError: boom bang", "exits": "SystemExit: 3", "missing": "ModuleNotFoundError", "absent": "AttributeError",
          "no_colon": "ValueError", "number": "int, not"}


def test_a_broken_entry_point_of_a_package_is_one_message(broken: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(broken)
    table: Registry[type] = Registry("structure", {"brute": "wrt.accel.brute_force:BruteForce"}, "wrt.structures", type)
    for name, why in BROKEN.items():
        for _ in range(2):
            with refused(what=why) as caught:
                table[name]
        assert "odd-things" in str(caught.value) and f"structure '{name}'" in str(caught.value)
    for entries in (table.values, table.items):
        with pytest.warns(SceneWarning) as warned:
            assert len(list(entries())) == 2
        assert len(warned) == len(BROKEN) and all("odd-things" in str(each.message) for each in warned)
    assert list(table) == ["brute", *BROKEN, "good"] and table["good"] is table["brute"]
    with pytest.raises(ModuleNotFoundError):  # an error of the table itself
        Registry("number", {"own": "odd_module_that_is_missing:x"})["own"]


@pytest.mark.parametrize("command", [(), ("bench",)])
def test_help_lists_the_other_commands_and_a_line_for_each_broken_one(command: tuple[str, ...], broken: Path) -> None:
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(broken), os.environ.get("PYTHONPATH", ""), str(ROOT)])}
    helped, failed, good = (subprocess.run([sys.executable, "-m", "wrt", *command, word], capture_output=True, text=True, env=environment)
                            for word in ("--help", "raises", "good"))
    assert helped.returncode == 0 and "It works." in helped.stdout and ("rtcore" if command else "render") in helped.stdout
    lines = helped.stderr.splitlines()
    assert len(lines) == len(BROKEN)
    for name, why in BROKEN.items():
        assert any(line.startswith("warning: ") and f"'{name}'" in line and "odd-things" in line and why in line for line in lines), name
    assert failed.returncode == 2 and len(failed.stderr.splitlines()) == 1 and "odd-things" in failed.stderr
    assert good.returncode == 0 and good.stdout == "good\n"


def test_a_render_imports_only_its_own_structure() -> None:
    code = ("import sys, wrt; from wrt.scene.shapes import icosphere; wrt.build(icosphere(1)); "
            "print(*(name for name in sys.modules if name.startswith('wrt.')))")
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    loaded = done.stdout.split()
    assert "wrt.accel.bvh.wide" in loaded
    assert not {"wrt.accel.cells.trees", "wrt.kernels.build.sbvh", "wrt.kernels.build.cells"} & set(loaded)
