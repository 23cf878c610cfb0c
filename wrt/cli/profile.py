"""Commands of the model of the RT core: `profile`, `whatif`, `bench rtcore`, `bench instructions`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from wrt.cli.bench import bench, by_mesh
from wrt.cli.common import (
    ACCEL,
    CLUSTER,
    SET,
    Crop,
    Names,
    Size,
    client_of,
    load,
    naming,
    say,
    say_json,
    settings_of,
    warnings_told,
)
from wrt.core.errors import InputError


@click.command()
@click.argument("scene", type=click.Path(path_type=Path))
@click.option("-o", "--output", type=click.Path(path_type=Path), help="Folder for heat maps, EXR layers, histograms and a report")
@click.option("--size", type=Size(), help="Pixels  [default: the scene's]")
@click.option("--spp", type=int, default=1, show_default=True, help="Samples a pixel")
@click.option("--max-depth", type=int, help="Bounces after the first hit  [default: the scene's]")
@SET
@click.option("--crop", type=Crop(), help="Only this rectangle, in pixels from the top left")
@click.option("--camera", help="A camera's name or number  [default: the first]")
@click.option("--accel", type=ACCEL, default="bvh", show_default=True, help="Acceleration structure")
@click.option("--gpu", default="rtx2080ti", show_default=True, help="What the model reckons for: rtx2080ti or rtx2060")
@click.option("--seed", type=int, default=0, show_default=True, help="Other samples")
@click.option("--threads", type=int, help="Threads on the CPU  [default: all cores]")
@click.option("-q", "--quiet", is_flag=True, help="No warnings")
@click.option("--json", "as_json", is_flag=True, help="Print as JSON")
def profile(scene: Path, output: Path | None, given: tuple[tuple[str, Any], ...], gpu: str, quiet: bool, as_json: bool,
            **options: Any) -> None:
    """What every ray of SCENE costs: counters by pixel, kind and depth, and a model of the RT core."""
    from wrt.core.checks import require_known
    from wrt.lab.rtcore import profile_report as report
    from wrt.lab.rtcore.parameters import GPUS
    from wrt.lab.rtcore.profiler import profile as measure

    require_known(gpu, GPUS, "GPU")
    if output is not None:
        report.check_folder(output)
    settings = settings_of(given, {name: options.pop(name) for name in ("size", "max_depth")}, spp="--spp")
    loaded = load(scene, quiet).with_settings(**settings)
    with warnings_told(quiet), naming(scene):
        found = measure(loaded, **options)
    rows = report.model_rows(found, GPUS[gpu])
    text = report.summary(found, rows, GPUS[gpu])
    paths = [] if output is None else report.write_report(found, text, output)
    if as_json:
        say_json({"scene": found.scene, "size": found.size, "spp": found.spp, "rays": len(found.rays), "seconds": found.seconds,
                  "by_depth": found.by_depth(), "model": [row.as_dict() for row in rows], "output": [str(path) for path in paths]})
        return
    click.echo(text)
    for path in paths:
        click.echo(path)


STUDIES = ("width", "stack", "planes", "order", "sorting", "rates")


@click.command()
@click.argument("study", type=click.Choice(STUDIES))
@click.argument("mesh", type=click.Path(path_type=Path))
@click.option("--kinds", type=Names(), default=("primary", "diffuse"), help="Of rays: primary, shadow, diffuse, random")
@click.option("--rays", type=int, default=2**15, show_default=True, help="Rays of each kind")
@click.option("--gpu", default="rtx2080ti", show_default=True, help="What the model reckons for: rtx2080ti or rtx2060")
@click.option("--seed", type=int, default=0, show_default=True, help="Other rays")
@click.option("--inside", is_flag=True, help="The camera stands in the middle of the mesh's box, as in a room")
@click.option("-o", "--output", type=click.Path(path_type=Path), help="Write the table as Markdown (.md)")
@click.option("-q", "--quiet", is_flag=True, help="No progress, no warnings")
@click.option("--json", "as_json", is_flag=True, help="Print as JSON")
def whatif(study: str, mesh: Path, output: Path | None, quiet: bool, as_json: bool, **options: Any) -> None:
    """Change one thing of the RT core's design, and count the same rays through MESH again.

    STUDY: width (node width, format and volume), stack (entries, with restarts), planes (bits of a box plane), order (nearer
    child first, early stop), sorting (of rays), rates (boxes a clock against triangles a clock).
    """
    from wrt.lab.rtcore import whatif as studies

    plan = studies.Plan("width" if study == "rates" else study, mesh, **options)
    check_report(output)
    tell = say if not quiet else lambda line: None
    with warnings_told(quiet):
        if study == "rates":
            rates = studies.rates(plan, tell)
            text = studies.rates_markdown(rates)
            data = [{"structure": row.structure, "kind": row.kind, "boxes": row.boxes, "triangles": row.triangles,
                     "rays_per_second": row.prediction.rays_per_second, "limit": row.prediction.bottleneck,
                     "clocks": row.prediction.terms, "doubled": row.doubled} for row in rates]
        else:
            rows = studies.run(plan, lambda row: tell("  ".join(studies.cells(row))))
            text, data = studies.markdown(rows), [row.as_dict() for row in rows]
    if output is not None:
        output.write_text(f"# What if: {study}, {mesh.name}\n\n{text}\n", encoding="utf-8")
    if as_json:
        say_json({"study": study, "mesh": mesh.name, "rows": data, "output": output})
        return
    click.echo(text)


def check_report(output: Path | None) -> None:
    """Raise InputError where a Markdown file cannot be written there, before any work is done for it."""
    if output is not None and (output.suffix.lower() != ".md" or not output.parent.is_dir()):
        raise InputError("the report is a .md file in a folder that is there", output)


@bench.command()
@click.argument("meshes", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option("--structures", type=Names(), default=(), help="Which, by name  [default: every BVH]")
@click.option("--kinds", type=Names(), default=("primary", "diffuse"), help="Of rays: primary, shadow, diffuse, random")
@click.option("--rays", type=int, default=2**16, show_default=True, help="Rays of each kind")
@click.option("--gpu", default="rtx2080ti", show_default=True, help="What the model reckons for: rtx2080ti or rtx2060")
@click.option("--seed", type=int, default=0, show_default=True, help="Other rays")
@click.option("--inside", is_flag=True, help="The camera stands in the middle of the mesh's box, as in a room")
@CLUSTER
@click.option("--software", is_flag=True, help="Also what the same rays take in software on a GTX 1080 Ti (compiles for Turing)")
@click.option("-o", "--output", type=click.Path(path_type=Path), help="Write the tables as Markdown (.md)")
@click.option("-q", "--quiet", is_flag=True, help="No progress, no warnings")
@click.option("--json", "as_json", is_flag=True, help="Print as JSON")
def rtcore(meshes: tuple[Path, ...], cluster: str | None, software: bool, output: Path | None, quiet: bool, as_json: bool,
           **options: Any) -> None:
    """The model of the RT core on MESHES: what limits it, rays a second as ranges, and which assumption moves them most."""
    from wrt.lab.rtcore import meshes as bench_rtcore
    from wrt.lab.rtcore.instructions import software_table
    from wrt.lab.rtcore.report import LEGEND, cells, parameter_table

    plan = bench_rtcore.Plan(meshes, **options)
    check_report(output)

    def told(row: Any) -> None:
        if not quiet:
            say("  ".join((row.mesh, row.structure, *cells(row.row))))

    with warnings_told(quiet):
        rows = by_mesh(bench_rtcore.run, plan, told, client_of(cluster))
    text = f"{bench_rtcore.markdown(rows)}\n{LEGEND}\n\n{parameter_table()}"
    in_software = bench_rtcore.in_software(rows) if software else []
    if software:
        text += f"\n\n{bench_rtcore.SOFTWARE_TITLE}\n\n{software_table(in_software)}"
    if output is not None:
        output.write_text(f"{text}\n", encoding="utf-8")
    if as_json:
        say_json({"rows": [{"mesh": row.mesh, "triangles": row.triangles, "structure": row.structure, "bytes": row.bytes,
                            **row.row.as_dict()} for row in rows], "output": output,
                  "software": [{"name": each.name, "instructions": each.instructions, "rays_per_second": each.rays_per_second}
                               for each in in_software]})
        return
    click.echo(text)


@bench.command()
@click.option("--structures", type=Names(), default=("bvh2",), show_default=True, help="Closest-hit kernels to look at, by name")
@click.option("--json", "as_json", is_flag=True, help="Print as JSON")
def instructions(structures: tuple[str, ...], as_json: bool) -> None:
    """The units in machine code for Turing: instructions of each box and triangle test; registers and code of traversals."""
    from wrt.accel.structures import ACCELERATORS
    from wrt.lab.rtcore import instructions as bench_instructions

    for name in structures:
        ACCELERATORS.check(name)
    units, codes = bench_instructions.units(), bench_instructions.traversals(structures)
    if as_json:
        say_json({"units": [{"unit": each.unit, "test": each.test, "instructions": each.instructions, **each.classes}
                            for each in units],
                  "traversals": {name: {"registers": code.registers, "stack": code.stack, "code_bytes": len(code.code),
                                        **code.classes()} for name, code in codes.items()}})
        return
    click.echo(f"{bench_instructions.unit_table(units)}\n\n{bench_instructions.traversal_table(codes)}\n\n"
               f"{bench_instructions.SOFTWARE_LEGEND}")
