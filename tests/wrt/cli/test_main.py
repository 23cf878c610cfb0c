"""The command line: its files, stdout and stderr, its messages for mistakes, and its state after Ctrl-C."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
import warp as wp
from PIL import Image

from tests.command_line import BOX_OBJ, Result, without_compiling
from tests.command_line import wrt as run
from tests.data import ROOT
from tests.device import NAME
from tests.picture_metadata import read_metadata
from wrt import __version__, load_accel
from wrt.cli import common as cli_common
from wrt.io.load import load_scene, schema
from wrt.picture.image import read_channels, read_image, write_image
from wrt.renderer.plan import features_of, switches

SMALL = ("--size", "32x18", "--spp", 2)
TWO_CAMERAS = """\
[materials.grey]
[[boxes]]
low = [-1, -1, -1]
high = [1, 1, 1]
material = "grey"
[cameras.front]
position = [1, 1, 5]
target = [0, 0, 0]
[cameras.side]
position = [5, 1, 1]
target = [0, 0, 0]
[background]
type = "gradient"
[[lights]]
type = "directional"
direction = [-1, -2, -1]
irradiance = 1
"""


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Run each test in a new folder that contains box.obj."""
    monkeypatch.chdir(tmp_path)
    Path("box.obj").write_text(BOX_OBJ)
    return tmp_path


def new_files() -> set[str]:
    return {path.name for path in Path().iterdir()} - {"box.obj", "scene.toml", "bad.toml"}


def refused(result: Result, *parts: str) -> None:
    """Expect exit code 2, an empty stdout, and on stderr one message that contains all parts, beside warnings."""
    assert result.code == 2 and result.out == "" and len(result.errors) == 1, result
    assert all(part in result.errors[0] for part in parts), result.err
    rest = [line for line in result.err.splitlines() if line and line != result.errors[0]]
    assert all(line.startswith(("warning: ", "Usage: ", "Try ")) for line in rest), result.err


def strict_json(text: str) -> Any:
    def fail(name: str) -> None:
        raise AssertionError(f"{name} is no JSON")

    return json.loads(text, parse_constant=fail)


# --- render -----------------------------------------------------------------------------------------------------------


def test_render_writes_a_picture_and_says_its_name_on_stdout() -> None:
    result = run("render", "box.obj", *SMALL)
    assert (result.code, result.out) == (0, "box.png\n") and new_files() == {"box.png"}
    with Image.open("box.png") as image:
        assert image.size == (32, 18) and image.mode == "RGB"
    warning, *summary = result.err.splitlines()
    assert warning.startswith("warning: box.obj: it has no camera") and summary[0].startswith("2 spp, ")
    assert summary[0].endswith(" Mray/s") and summary[1].startswith("seconds: import ")
    metadata = read_metadata("box.png")
    assert metadata.items() >= {"scene": "box.obj", "camera": "framing", "spp": "2", "seed": "0"}.items()


def test_quiet_is_silent_but_for_the_data() -> None:
    assert run("render", "box.obj", *SMALL, "--quiet") == Result(0, "box.png\n", "")


def test_json_holds_statistics_and_nothing_else_is_on_stdout() -> None:
    result = run("render", "box.obj", *SMALL, "--seed", 7, "--aov", "depth", "-o", "a.png", "--json")
    facts = strict_json(result.out)
    assert result.code == 0 and result.out.count("\n") == 1
    assert facts["output"] == ["a.png", "a.depth.png"] and facts["spp"] == 2 and facts["seed"] == 7
    assert facts["accel"].keys() >= {"name", "nodes", "leaves", "depth", "bytes", "sah_cost"} and facts["accel"]["nodes"] > 0
    assert facts["samples"] == 2 * 32 * 18 <= facts["rays"] and facts["triangles"] == 12 and facts["interrupted"] is False
    assert {"import", "load", "upload", "build", "compile", "trace", "write"} <= facts["seconds"].keys()
    assert all(value >= 0 for value in facts["seconds"].values())


def test_json_is_json_whatever_is_in_it(capsys: pytest.CaptureFixture[str]) -> None:
    cli_common.say_json({"a": [float("nan"), (1, -float("inf"))], "b": np.float64("inf"), "c": Path("x"), "d": {1: True}})
    assert strict_json(capsys.readouterr().out) == {"a": [None, [1, None]], "b": None, "c": "x", "d": {"1": True}}


def test_layers_are_files_beside_a_png_and_channels_in_an_exr() -> None:
    names = ("depth", "normal", "albedo", "prim_id", "material_id")
    assert run("render", "box.obj", *SMALL, "-o", "a.png", "--aov", ",".join(names)).code == 0
    assert new_files() == {"a.png", *(f"a.{name}.png" for name in names)} and Path("a.png").read_bytes()[24] == 8
    result = run("render", "box.obj", *SMALL, "-o", "b.exr", "--aov", "depth, normal")
    assert result.out == "b.exr\n" and {"depth.Z", "normal.X", "samples", "variance.R"} <= read_channels("b.exr").keys()
    assert "prim_id" not in read_channels("b.exr")


def test_a_crop_is_that_part_of_the_whole_picture() -> None:
    assert run("render", "box.obj", *SMALL, "-o", "whole.exr").code == 0
    assert run("render", "box.obj", *SMALL, "-o", "part.exr", "--crop", "5, 3,21,10").code == 0
    whole, part = read_channels("whole.exr"), read_channels("part.exr")
    assert whole.keys() == part.keys() and all(np.array_equal(part[name], whole[name][3:10, 5:21]) for name in whole)


def test_tone_mapping_and_exposure_change_the_png_only() -> None:
    for suffix in ("png", "exr"):
        assert run("render", "box.obj", *SMALL, "-o", f"plain.{suffix}").code == 0
        assert run("render", "box.obj", *SMALL, "-o", f"shown.{suffix}", "--tonemap", "agx", "--exposure", -1).code == 0
    assert not np.array_equal(read_image("plain.png"), read_image("shown.png"))
    assert np.array_equal(read_image("plain.exr"), read_image("shown.exr"))


def test_cameras_by_name_and_number() -> None:
    Path("scene.toml").write_text(TWO_CAMERAS)
    for name, expected in (("front", "front"), ("side", "side"), ("0", "front"), ("1", "side")):
        assert run("render", "scene.toml", *SMALL, "--camera", name, "-o", "a.png").code == 0
        assert read_metadata("a.png")["camera"] == expected
    for name in ("top", "2", "-1", ""):
        for command in (("render", *SMALL), ("info",)):
            refused(run(*command, "scene.toml", "--camera", name), f"scene.toml: the scene has no camera {name!r}",
                    "its cameras are 'front' (index 0), 'side' (index 1)")


def test_a_time_limit_leaves_a_picture_of_whole_samples() -> None:
    result = run("render", "box.obj", "--size", "32x18", "--spp", 1 << 24, "--time-limit", "0.2s", "-o", "a.exr", "--json")
    samples = read_channels("a.exr")["samples"]
    assert result.code == 0 and strict_json(result.out)["timed_out"] is True and "(time limit)" in result.err
    assert 1 <= samples.min() == samples.max() < 1 << 24


# --- mistakes ---------------------------------------------------------------------------------------------------------

WRONG = [
    (["--size", "0x0"], "size must be 1x1 to 32768x32768"), (["--size", "640x"], "write 640x360"), (["--size", "0"], "size must be"),
    (["--size", "9" * 5000 + "x1"], "write 640x360"), (["--spp", "0"], "spp must be 1 to"), (["--spp", "many"], "'--spp'"),
    (["--seed", str(2**32)], "seed must be 0 to"), (["--crop", "1,2,3"], "write X0,Y0,X1,Y1"),
    (["--accel", "nope"], "no structure 'nope'; there is bvh"), (["--device", "nope"], "no device 'nope'; there is cpu"),
    (["--filter", "nope"], "filter must be one of box"), (["--aov", "depth,nope"], "no AOV 'nope'"),
    (["--bits", "7"], ".png is written with 8 or 16 bits, not 7"), (["--threads", "0"], "threads must be 1 to"),
    (["--max-depth", "65"], "max_depth must be 0 to 64"), (["--min-throughput", "nan"], "min_throughput must be finite"),
    (["--exposure", "1e9"], "exposure must be"), (["--time-limit", "soon"], "write 30s, 5m or 1h"), (["--nope"], "--nope"),
    (["another.obj"], "another.obj"), (["-o", "nowhere/a.png"], "nowhere/a.png: its folder does not exist"),
    (["-o", "folder.png"], "folder.png: is a folder"), (["-o", "a.gif"], "a.gif: cannot write .gif; use .png, .exr, .hdr"),
    (["-o", "a"], "a: cannot write a file without a suffix"), (["-o", "a" * 300 + ".png"], "too long"),
    (["-o", "a.png", "--aov", "depth,normal"], "a.normal.png: is a folder"),
]


@pytest.mark.parametrize(("arguments", "message"), WRONG, ids=lambda value: str(value)[:40])
def test_a_wrong_option_is_reported_before_the_scene_is_read(arguments: list[str], message: str) -> None:
    Path("box.obj").write_text("")  # a command that reads it ends with another error
    Path("box.png").write_bytes(b"old")
    for name in ("folder.png", "a.normal.png"):
        Path(name).mkdir()
    result = run("render", "box.obj", *arguments)
    refused(result, message)
    assert "warning" not in result.err and Path("box.png").read_bytes() == b"old"
    assert new_files() == {"box.png", "folder.png", "a.normal.png"}


@pytest.mark.parametrize("crop", ["0,0,33,18", "5,5,5,6"])
def test_a_crop_outside_the_picture(crop: str) -> None:
    refused(run("render", "box.obj", *SMALL, "--crop", crop), f"crop must be within the picture of 32x18, got {crop}")
    assert new_files() == set()


@pytest.mark.parametrize(("scene", "message"), [
    ("nothing.xyz", "nothing.xyz: no such file"), (".", ".: is no scene file"), ("box.txt", "box.txt: is no scene file"),
    ("empty.toml", "empty.toml: the scene has no shapes"), ("a" * 300 + ".obj", "too long"), ("empty.obj", "empty.obj: has no triangles"),
])
@pytest.mark.parametrize("command", ["render", "validate"])
def test_a_wrong_scene(command: str, scene: str, message: str) -> None:
    for name in ("box.txt", "empty.toml", "empty.obj"):
        Path(name).write_text("")
    refused(run(command, scene), message)
    assert new_files() == {"box.txt", "empty.toml", "empty.obj"}


def test_what_is_found_late_names_the_scene_and_leaves_the_old_picture() -> None:
    holes = '[materials.holes]\nalpha_mode = "mask"\nalbedo_texture = {checkerboard = {}}\n'
    sphere = '[[spheres]]\ncenter = [0, 0, 0]\nradius = 1\nmaterial = "holes"\nname = "sieve"\n'
    Path("bad.toml").write_text(TWO_CAMERAS + holes + sphere)
    Path("bad.png").write_bytes(b"old")
    refused(run("render", "bad.toml", *SMALL), "bad.toml: sphere 'sieve': a cut-out texture needs a mesh")
    assert new_files() == {"bad.png"} and Path("bad.png").read_bytes() == b"old"


@pytest.mark.parametrize("command", [("info",), ("render", *SMALL), ("build", "-o", "b\x1b[31m.accel")], ids=lambda command: command[0])
def test_control_characters_of_names_are_escaped_on_stdout(command: tuple[Any, ...]) -> None:
    name = "a\x1b[31mred\x07\x9b.obj"
    Path(name).write_bytes(Path("box.obj").read_bytes())
    result = run(command[0], name, *command[1:])
    assert result.code == 0, result
    assert not re.search(r"[\x00-\x09\x0b-\x1f\x7f-\x9f]", result.out + result.err)
    assert "\\x1b" in result.out or "\\x07" in result.out


@pytest.mark.parametrize(("ask", "words"), [
    (lambda: np.empty(1 << 58, np.uint8), "Unable to allocate"), (lambda: wp.empty((1 << 20, 1 << 20, 1 << 10)), "Failed to allocate"),
    (Mock(side_effect=RuntimeError("can't start new thread")), "can't start new thread")])  # words of CPython
def test_no_memory_is_no_traceback(ask: Callable[[], object], words: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("wrt.renderer.render.prepare", lambda *arguments: ask())
    refused(run("render", "box.obj"), f"error: not enough memory: {words}")


def test_a_width_alone_keeps_the_scenes_aspect_ratio() -> None:
    Path("scene.toml").write_text(TWO_CAMERAS + "[settings]\nsize = [60, 20]\nspp = 1\n")
    assert run("render", "scene.toml", "--size", 31, "-o", "a.jpg").code == 0
    with Image.open("a.jpg") as image:
        assert image.size == (31, 10) and image.format == "JPEG" and "wrt:spp=1" in image.getexif()[0x010E]


# --- the other commands -----------------------------------------------------------------------------------------------


def test_info_tells_what_is_on_and_what_is_off() -> None:
    Path("scene.toml").write_text(TWO_CAMERAS)
    scene = load_scene("scene.toml")
    on_off = switches(features_of(scene, scene.camera()))
    facts = dict(line.split(": ", 1) for line in run("info", "scene.toml").out.splitlines())
    assert facts["triangles"] == "12" and facts["cameras"] == "front; side" and facts["background"] == "GradientBackground"
    assert facts["features on"].split(", ") == [name for name, on in on_off.items() if on]
    assert facts["features off"].split(", ") == [name for name, on in on_off.items() if not on]
    told = strict_json(run("info", "scene.toml", "--json").out)
    assert told["features"] == on_off and told["bounds_low"] == [-1, -1, -1] and told["bounds_high"] == [1, 1, 1]


def test_schema_is_the_json_schema() -> None:
    result = run("schema")
    assert result.code == 0 and result.err == "" and strict_json(result.out) == schema()


def test_validate_tells_of_every_file() -> None:
    Path("scene.toml").write_text(TWO_CAMERAS)
    Path("bad.toml").write_text("[settings]\nspp = 0\nnothing = 1\n")
    good = run("validate", "scene.toml", "box.obj")
    assert (good.code, good.out) == (0, "scene.toml: ok\nbox.obj: ok\n")
    assert good.err.startswith("warning: box.obj: ") and len(good.err.splitlines()) == 1
    mixed = run("validate", "scene.toml", "bad.toml", "nothing.glb", "box.obj")
    assert (mixed.code, mixed.out) == (2, "scene.toml: ok\nbox.obj: ok\n")
    assert [line.split(": ")[1] for line in mixed.errors] == ["bad.toml", "nothing.glb"]
    assert "settings.spp" in mixed.err and "settings.nothing" in mixed.err
    refused(run("validate"), "Missing argument")


def test_compare_measures_and_fails_past_its_limits() -> None:
    image = np.random.default_rng(0).random((20, 30, 3)).astype(np.float32)
    write_image("a.exr", image)
    write_image("b.exr", image + np.float32(0.1))
    same = run("compare", "a.exr", "a.exr", "--max-mse", 0, "--min-psnr", 99, "--max-flip", 0)
    assert same.code == 0 and "mse: 0\n" in same.out and "psnr: inf\n" in same.out and same.err == ""
    assert strict_json(run("compare", "a.exr", "a.exr", "--json").out).items() >= {"mse": 0.0, "psnr": None}.items()
    differs = run("compare", "b.exr", "a.exr", "--json", "-o", "d.png")
    assert differs.code == 0 and strict_json(differs.out)["mse"] == pytest.approx(0.01, rel=1e-4)
    with Image.open("d.png") as image_file:
        assert image_file.width > 480  # a heat map with its scale
    broken = run("compare", "b.exr", "a.exr", "--max-mse", 0.001, "--max-relmse", 1e9, "--min-psnr", 99, "--max-flip", 0)
    assert broken.code == 1 and [line.split()[0] for line in broken.err.splitlines()] == ["mse", "psnr", "flip"]


@pytest.mark.parametrize(("arguments", "message"), [
    (["a.exr", "nothing.png"], "nothing.png: cannot be read"), (["box.obj", "a.exr"], "box.obj: is no image file"),
    (["a.exr", "small.exr"], "different sizes, 30x20 and 8x4"), (["a.exr", "a.exr", "-o", "d.exr"], "d.exr: must be a .png"),
    (["a.exr", "a.exr", "--tonemap", "nope"], "tonemap must be one of"),
    (["a.exr", "a.exr", "--max-mse", "little"], "'--max-mse'"), (["a.exr"], "Missing argument"),
], ids=str)
def test_compare_refuses(arguments: list[str], message: str) -> None:
    write_image("a.exr", np.ones((20, 30, 3)))
    write_image("small.exr", np.ones((4, 8, 3)))
    refused(run("compare", *arguments), message)
    assert not Path("d.exr").exists() and not Path("d.png").exists()


def test_compile_reports_the_kernels() -> None:
    scene = str(ROOT / "scenes" / "fisheye.toml")
    result = run("compile", scene, "--json")
    done = json.loads(result.out)["compiled"]
    assert result.code == 0 and [entry["for"] for entry in done] == ["queries of bvh", scene]
    assert ("shade_wave" if NAME == "cpu" else "render") in done[1]["kernels"] and all(entry["seconds"] >= 0.0 for entry in done)
    result = run("compile", "--accel", "bvh")
    assert result.code == 0 and result.out.startswith("queries of bvh: 2 kernels, ")


def test_devices_lists_the_cpu_first() -> None:
    result = run("devices")
    assert result.code == 0 and result.err == "" and result.out.startswith("cpu: ") and "threads\n" in result.out


def test_help_and_version() -> None:
    for command in ("", "render", "info", "schema", "validate", "compare", "devices"):
        result = run(*([command] if command else []), "--help")
        assert result.code == 0 and result.out.startswith("Usage: ") and result.err == ""
    assert run("render", "-h").out == run("render", "--help").out
    assert run().code == 2 and "Commands:" in run().err + run().out
    refused(run("rendr"), "No such command 'rendr'")
    assert run("--version") == Result(0, f"wrt {__version__}\n", "")  # the version of this code, whether wrt is installed or not


# --- real processes ---------------------------------------------------------------------------------------------------


def default_signals() -> None:
    """Reset the signals that the parent process may ignore, as under nohup or in the background."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_DFL)


def process(*arguments: object, code: str = "", **options: Any) -> subprocess.Popen[str]:
    """Start `python -m wrt` with arguments. code: Python code to run first."""
    start = ["-c", f"{code}\nfrom wrt.cli.main import main; main()"] if code else ["-m", "wrt"]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), **options.pop("environment", {})}
    return subprocess.Popen([sys.executable, *start, *map(str, arguments)], text=True, env=environment,
                            stdout=subprocess.PIPE, stderr=subprocess.PIPE, preexec_fn=default_signals, **options)


def finish(running: subprocess.Popen[str]) -> Result:
    try:
        out, err = running.communicate(timeout=120)
    finally:
        running.kill()  # if it has not ended
    return Result(running.returncode, out, without_compiling(err))


@pytest.mark.skipif(sys.platform == "win32", reason="needs a shell")
@pytest.mark.parametrize(("redirection", "code", "out", "err"), [
    ("2>&-", 0, "box.png\n", ""), (">&-", 0, "", "seconds"), (">&- 2>&-", 0, "", ""), ("<&-", 0, "box.png\n", "seconds"),
    (">/dev/full", 2, "", "No space left on device"),
])
def test_closed_and_full_streams(redirection: str, code: int, out: str, err: str) -> None:
    if "full" in redirection and not Path("/dev/full").is_char_device():
        pytest.skip("this system has no /dev/full")
    shell = ["sh", "-c", f'"$0" "$@" {redirection}', sys.executable, "-m", "wrt", "render", "box.obj", *map(str, SMALL)]
    done = subprocess.run(shell, text=True, capture_output=True, env={**os.environ, "PYTHONPATH": str(ROOT)}, check=False)
    assert (done.returncode, done.stdout) == (code, out) and err in done.stderr and "Traceback" not in done.stderr
    assert read_image("box.png").shape == (18, 32, 3)


@pytest.mark.skipif(sys.platform == "win32", reason="needs pipes of POSIX")
def test_a_reader_that_ends_first_is_no_error() -> None:
    receiving, sending = os.pipe()
    os.close(receiving)
    done = subprocess.run([sys.executable, "-m", "wrt", "schema"], stdout=sending, stderr=subprocess.PIPE, check=False)
    os.close(sending)
    assert (done.returncode, done.stderr) == (141, b"")


@pytest.mark.parametrize("command", [(), ("bench",)])
def test_the_list_of_commands_fits_in_80_columns(command: tuple[str, ...], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    lines = run(*command, "--help").out.split("Commands:\n")[1].splitlines()
    assert len(lines) > 5
    assert all(re.fullmatch(r"  \S+ +\S.*\w\.?", line) and not line.endswith("...") and len(line) <= 80 for line in lines), lines


def test_a_structure_in_a_file_holds_its_mesh() -> None:
    assert run("build", "box.obj", "-q", "-o", "box.accel").code == 0
    assert len(load_accel("box.accel").geometry) == 12


# Let the real reporter print its first line at once, so that the test knows when the process traces.
AT_ONCE = "import wrt.renderer.progress; wrt.renderer.progress.LINE_EVERY = 0.0"


@pytest.mark.parametrize(("number", "times"), [(signal.SIGINT, 1), (signal.SIGINT, 5), (signal.SIGTERM, 1), (signal.SIGHUP, 1)])
def test_a_process_that_is_interrupted_writes_what_it_has(number: int, times: int) -> None:
    running = process("render", "box.obj", "--size", "320x180", "--spp", 1 << 24, "-o", "a.exr", "--aov", "depth", code=AT_ONCE)
    assert running.stderr is not None
    assert any("Mray/s" in line for line in running.stderr)
    for _ in range(times):
        running.send_signal(number)
    result = finish(running)
    assert (result.code, result.out) == (128 + number, "a.exr\n") and "(interrupted" in result.err and "Traceback" not in result.err
    samples = read_channels("a.exr")["samples"]
    assert samples.shape == (180, 320) and samples.max() - samples.min() <= 64 and 0 < samples.max() < 1 << 24
    assert np.isfinite(read_image("a.exr")).all() and new_files() == {"a.exr"}


LOADING = """
import sys, wrt.io.load
def slow(path, load=wrt.io.load.load_scene, **staging):
    print("now", file=sys.stderr, flush=True)
    while True: load(path, **staging)
wrt.io.load.load_scene = slow
"""
COMPILING = """
import os, wrt.renderer.prepare
def reported(kernel, device, load=wrt.renderer.prepare.load_kernel):
    os.write(2, b"now\\n")  # one write call, because several threads compile while the main thread is interrupted
    load(kernel, device)
wrt.renderer.prepare.load_kernel = reported
"""


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, LOADING), (signal.SIGTERM, COMPILING)], ids=["loading", "compiling"])
def test_a_process_that_is_interrupted_early_leaves_nothing(number: int, code: str, folder: Path) -> None:
    cold = {"WARP_CACHE_PATH": str(folder / "cache")}  # an empty cache, so that kernels are compiled
    running = process("render", "box.obj", "-o", "a.png", "--spp", 1 << 24, code=code, environment=cold)
    assert running.stderr is not None
    assert any(line == "now\n" for line in running.stderr)
    running.send_signal(number)
    result = finish(running)
    assert (result.code, result.out) == (128 + number, "") and "interrupted\n" in result.err
    assert "Traceback" not in result.err and new_files() <= {"cache"}


FAILING = """
import time, wrt.renderer.prepare
from wrt.core.errors import InputError
def slow(kernel, device):
    while True: time.sleep(1.0)
def failing(*arguments): raise InputError("a transform that is found late")
wrt.renderer.prepare.load_kernel, wrt.renderer.prepare.upload_scene = slow, failing
"""


def test_an_error_does_not_wait_for_the_compiler() -> None:
    refused(finish(process("render", "box.obj", code=FAILING)), "box.obj: a transform that is found late")


def test_a_profile_of_a_command_is_written(folder: Path) -> None:
    result = subprocess.run([sys.executable, "-m", "cProfile", "-o", "a.prof", "-m", "wrt", "--version"], capture_output=True,
                            text=True, check=False)
    assert (result.returncode, result.stderr) == (0, "") and Path("a.prof").stat().st_size > 1000
