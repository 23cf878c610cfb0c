"""`python -m wrt compile`."""

from __future__ import annotations

import json

from click.testing import CliRunner

from tests.data import ROOT
from tests.device import NAME
from wrt.cli.build import compile_kernels


def test_the_command_reports_the_compiled_kernels() -> None:
    scene = str(ROOT / "scenes" / "fisheye.toml")
    result = CliRunner().invoke(compile_kernels, [scene, "--json"])
    done = json.loads(result.stdout)["compiled"]
    assert result.exit_code == 0 and [entry["for"] for entry in done] == ["queries of bvh", scene]
    assert ("shade_wave" if NAME == "cpu" else "render") in done[1]["kernels"] and all(entry["seconds"] >= 0.0 for entry in done)
    result = CliRunner().invoke(compile_kernels, ["--accel", "bvh"])
    assert result.exit_code == 0 and result.stdout.startswith("queries of bvh: 2 kernels, ")
