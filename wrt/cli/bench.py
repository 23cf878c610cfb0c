"""`bench`: the commands that measure meshes. They parse, call and print, as those of wrt.cli.main do."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from wrt.cli.common import ACCEL, Commands, Names, warnings_reported
from wrt.cli.reporting import MESHES, Reporting, measure, reporting

KINDS = click.option("--kinds", type=Names(), default=("primary", "shadow", "diffuse", "random"), help="Of rays  [default: all]")
SEED = click.option("--seed", type=int, default=0, show_default=True, help="Other rays")


@click.group(cls=Commands)
def bench() -> None:
    """Measure: speed against error, and one method against another."""


@bench.command()
@MESHES
@click.option("--size", type=int, default=512, show_default=True, help="Pixels a side as triangles grow")
@click.option("--max-size", type=int, default=1024, show_default=True, help="Pixels a side at the end of the sweep from 64 on")
@click.option("--max-triangles", type=int, default=1_500_000, show_default=True, help="Meshes are cut finer up to this many")
@click.option("--runs", type=int, default=7, show_default=True, help="Runs of each kind, alternating")
@click.option("--accel", type=ACCEL, default="bvh", show_default=True, help="Acceleration structure")
@click.option("--device", default="cpu", show_default=True, help="cpu, cuda:0, ... (see `devices`)")
@click.option("--threads", type=int, help="Threads on the CPU  [default: all cores]")
@reporting("Folder for a report with plots", cluster=True)
def visibility(how: Reporting, **options: Any) -> None:
    """Rasterising against ray casting, as triangles and pixels grow: the cost of both, and where they differ.

    MESHES: mesh files; without any, a sphere and a terrain.
    """
    from wrt.lab.bench import visibility as study

    measure(how, study, options)


@bench.command()
@MESHES
@click.option("--rays", type=int, default=2**17, show_default=True, help="Rays of each kind")
@click.option("--runs", type=int, default=9, show_default=True, help="Runs of each unit, by turns")
@click.option("--accel", type=ACCEL, default="bvh", show_default=True, help="Acceleration structure")
@SEED
@reporting("Write the table as Markdown (.md)")
def units(how: Reporting, **options: Any) -> None:
    """The default triangle and box tests beside the others: what they cost, as ratios with their spread, on one thread.

    MESHES: mesh files; without any, a sphere, a terrain and a teapot.
    """
    from wrt.lab.bench import units as study

    plan = study.Plan(**options)
    how.check_markdown()
    machine = study.machine()
    with warnings_reported(how.quiet):
        rows = study.run(plan, how.now_and_then)
    text = study.text(rows, plan, machine)
    how.write(text)
    how.end(text, {"machine": machine, "rows": [vars(row) for row in rows], "output": how.output})


@bench.command()
@MESHES
@click.option("--structures", type=Names(), default=("bvh",), help="Of wrt, by name; ratios are of the first  [default: bvh]")
@click.option("--rivals", type=Names(), default=(), help="embree, embree_fast, warp, open3d  [default: those that are installed]")
@KINDS
@click.option("--rays", type=int, default=100_000, show_default=True, help="Rays of each kind")
@click.option("--runs", type=int, default=7, show_default=True, help="Runs of each, by turns")
@click.option("--threads", default="both", show_default=True, help="one (by its CPU time), all (by the clock) or both")
@SEED
@reporting("Write the tables as Markdown (.md)", cluster=True)
def peers(how: Reporting, **options: Any) -> None:
    """wrt beside Embree (robust and fast) and Warp's mesh_query_ray: the same rays by turns, on one thread and on all, with ratios
    and answers that differ.

    MESHES: mesh files; without any, a sphere.
    """
    from wrt.lab.bench import peers as study

    measure(how, study, options)


@bench.command()
@MESHES
@click.option("--structures", type=Names(), default=(), help="Which, by name  [default: all but brute_force]")
@KINDS
@click.option("--rays", type=int, default=100_000, show_default=True, help="Rays of each kind")
@click.option("--runs", type=int, default=5, show_default=True, help="Runs of each structure, alternating")
@click.option("--builds", type=int, default=1, show_default=True, help="Builds of each structure")
@click.option("--max-triangles", type=int, default=1_000_000, show_default=True, help="Without meshes, the terrain grows to this")
@click.option("--threads", type=int, default=1, show_default=True, help="Threads to search with (builds use all cores)")
@click.option("--stadium", is_flag=True, help="Each mesh in a stadium a thousand times its size, with the rays it has alone")
@SEED
@reporting("Folder for a report with plots", cluster=True)
def accel(how: Reporting, **options: Any) -> None:
    """Structure against structure: time to build, memory, steps and time to search, and answers that differ (none may).

    MESHES: mesh files; without any, a terrain that grows from a thousand triangles on.
    """
    from wrt.lab.bench import accel as study

    measure(how, study, options)


@bench.command()
@MESHES
@click.option("--builders", type=Names(), default=(), help="Which, by name  [default: all]")
@click.option("--rays", type=int, default=2**18, show_default=True, help="Rays into each mesh")
@click.option("--builds", type=int, default=3, show_default=True, help="Builds of each builder, after the first")
@click.option("--runs", type=int, default=7, show_default=True, help="Runs of each volume, alternating")
@click.option("--threads", type=int, help="Threads to build with  [default: all cores]")
@SEED
@reporting(None, cluster=True)
def bvh(how: Reporting, **options: Any) -> None:
    """Builders of binary BVHs over MESHES: quality, time and memory; and boxes, spheres and 14-DOPs around the same tree."""
    from wrt.lab.bench import bvh as study

    measure(how, study, options)


@bench.command()
@click.argument("meshes", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option("--structures", type=Names(), default=(), help="Which, by name  [default: every BVH]")
@click.option("--kinds", type=Names(), default=("primary", "diffuse"), help="Of rays: primary, shadow, diffuse, random")
@click.option("--rays", type=int, default=2**16, show_default=True, help="Rays of each kind")
@click.option("--gpu", default="rtx2080ti", show_default=True, help="What the model reckons for: rtx2080ti or rtx2060")
@SEED
@click.option("--inside", is_flag=True, help="The camera stands in the middle of the mesh's box, as in a room")
@click.option("--software", is_flag=True, help="Also what the same rays take in software on a GTX 1080 Ti (compiles for Turing)")
@reporting("Write the tables as Markdown (.md)", cluster=True)
def rtcore(how: Reporting, software: bool, **options: Any) -> None:
    """The model of the RT core on MESHES: what limits it, rays a second as ranges, and which assumption moves them most."""
    from wrt.cli.common import client_of
    from wrt.lab.bench.sweep import by_mesh
    from wrt.lab.rtcore import meshes as study
    from wrt.lab.rtcore.instructions import software_table
    from wrt.lab.rtcore.report import LEGEND, parameter_table

    plan = study.Plan(**options)
    how.check_markdown()
    with warnings_reported(how.quiet):
        rows = by_mesh(study.run, plan, lambda row: how.progress(study.line(row)), client_of(how.cluster))
    text = f"{study.markdown(rows)}\n{LEGEND}\n\n{parameter_table()}"
    in_software = study.in_software(rows) if software else []
    if software:
        text += f"\n\n{study.SOFTWARE_TITLE}\n\n{software_table(in_software)}"
    how.write(text)
    how.end(text, {"rows": [row.as_dict() for row in rows], "output": how.output, "software": [
        {"name": each.name, "instructions": each.instructions, "rays_per_second": each.rays_per_second} for each in in_software]})


@bench.command()
@click.option("--structures", type=Names(), default=("bvh2",), show_default=True, help="Closest-hit kernels to look at, by name")
@click.option("--json", "as_json", is_flag=True, help="Print as JSON")
def instructions(structures: tuple[str, ...], as_json: bool) -> None:
    """The units in machine code for Turing: instructions of each box and triangle test; registers and code of traversals."""
    from wrt.accel.structures import ACCELERATORS
    from wrt.lab.rtcore import instructions as study

    for name in structures:
        ACCELERATORS.check(name)
    units, codes = study.units(), study.traversals(structures)
    text = f"{study.unit_table(units)}\n\n{study.traversal_table(codes)}\n\n{study.SOFTWARE_LEGEND}"
    Reporting(as_json=as_json).end(text, {
        "units": [{"unit": each.unit, "test": each.test, "instructions": each.instructions, **each.classes} for each in units],
        "traversals": {name: {"registers": code.registers, "stack": code.stack, "code_bytes": len(code.code), **code.classes()}
                       for name, code in codes.items()}})
