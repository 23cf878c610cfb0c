"""A command, a measurement and a structure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import MISSING, dataclass
from functools import partial
from typing import Any

import click

import wrt
from wrt.accel.bvh.wide import Bvh4, Bvh4Options
from wrt.cli.common import load, say, shared
from wrt.cli.reporting import measured
from wrt.lab import STRUCTURES, Plan, option, the_meshes
from wrt.lab.bench.report import Row, tabled

TITLE = "Memory"
LEGEND = "Bytes of the structure per triangle."
COLUMNS = {"mesh": "{mesh}", "structure": "{structure}", "B/tri": "{bytes:.1f}"}


@dataclass(frozen=True)
class SmallLeavesOptions(Bvh4Options):
    """Bvh4Options with another default."""

    max_leaf: int = 2


class SmallLeaves(Bvh4):
    """bvh4 with smaller leaves."""

    name = "small_leaves"
    options = SmallLeavesOptions


@click.command()
@shared("scene")
def triangles(scene):
    """Print how many triangles SCENE has."""
    say(sum(len(each.mesh.faces) for each in load(scene, quiet=False).objects), err=False)


@dataclass(frozen=True)
class Memory(Plan):
    """Memory of structures over MESHES."""

    COMMAND, STUDY, QUICK = "bench memory", __name__, {"structures": ("bvh4",)}
    meshes: Sequence[Any] = the_meshes(MISSING)
    structures: Sequence[str] = option(("bvh4", "small_leaves"), "Names of structures", of=STRUCTURES)


def groups(plan):
    return (partial(rows_of, path, name) for path in plan.meshes for name in plan.structures)


def rows_of(path, name):
    structure = wrt.build(path, name)
    return [Row(mesh=str(path), structure=name, bytes=structure.stats.bytes / structure.geometry.n_triangles)]


def parts(rows, plan):
    return [tabled(COLUMNS, rows)]


memory = measured(Memory)
