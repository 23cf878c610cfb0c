"""`bench`: the commands that measure meshes, each by a study of wrt.lab."""

from __future__ import annotations

import click

from wrt.cli.common import Commands, Names
from wrt.cli.reporting import Reporting, measured
from wrt.lab import plans


@click.group(cls=Commands)
def bench() -> None:
    """Measure: speed against error, and one method against another."""


for plan in (plans.Visibility, plans.Units, plans.Peers, plans.Accel, plans.Bvh, plans.RtCore):
    measured(bench, plan)


@bench.command()
@click.option("--structures", type=Names(), default=("bvh2",), show_default=True, help="Closest-hit kernels to look at, by name")
@click.option("--json", "as_json", is_flag=True, help="Print as JSON")
def instructions(structures: tuple[str, ...], as_json: bool) -> None:
    """The units in machine code for Turing: instructions of each box and triangle test; registers and code of traversals."""
    from wrt.accel.structures import ACCELERATORS
    from wrt.lab.bench.report import markdown
    from wrt.lab.rtcore import instructions as study

    for name in structures:
        ACCELERATORS.check(name)
    units, codes = study.units(), study.traversals(structures)
    Reporting(as_json=as_json).end(markdown(study.tables(units, codes)), {
        "units": [{"unit": each.unit, "test": each.test, "instructions": each.instructions, **each.classes} for each in units],
        "traversals": {name: {"registers": code.registers, "stack": code.stack, "code_bytes": len(code.code), **code.classes()}
                       for name, code in codes.items()}})
