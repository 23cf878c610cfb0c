"""README and docs/: command lines parse and run, Python blocks run, links lead to files, plots and tables agree with their data."""

from __future__ import annotations

import ast
import importlib
import inspect
import re
import runpy
import shlex
import shutil
from collections.abc import Iterator
from pathlib import Path
from statistics import geometric_mean
from typing import Any

import click
import numpy as np
import pytest

from tests.command_line import BOX_OBJ
from tests.command_line import wrt as run
from tests.data import ROOT
from tests.gltf_files import GltfFile
from tests.wrt.lab.rtcore.test_profiler import MIRRORS
from wrt.cli.main import cli
from wrt.io.mesh_file import load_mesh
from wrt.scene.shapes import icosphere

PAGES = [ROOT / "README.md", ROOT / "CHANGELOG.md", ROOT / "kernels" / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
NOTES = sorted((ROOT / "docs" / "lab_notes").glob("*.md"))  # dated: their commands and Python are not run
# Commands of other programs, and commands of wrt that have their own tests or that .ci/run runs.
OTHERS = ("pip install ", "pytest", "mkdocs ", "dask ", "python -m tests.fuzz ", "python -m tests.virtual_gpu ",
          "openssl req ", "python -m tests.inspect_all", "export DASK_", "ulimit -v ", "timeout -k ", "prlimit ")
# Placeholders in command lines, and the files of the fixture `folder` that replace them.
STANDS_FOR = {"MESH...": "model.ply", "MESH": "model.ply", "SCENE": "scenes/whitted.toml", "FILE.gif": "file.gif", "STUDY": "order",
              "bunny.ply": "model.ply", "FOLDER|FILE.gif|.png": "frames", "FOLDER": "folder"}
# Options to append to a command so that it takes little time. Commands in neither CHEAP nor SLOW are parsed, but not run.
CHEAP = {
    "render": ("--size", "32x18", "--spp", "4"), "info": (), "compile": (), "compare": (), "validate": (), "schema": (),
    "devices": (), "walk": (), "inspect": ("--spp", "1"),
    "profile": ("--size", "24x14"), "animate": ("--frames", "2", "--size", "32x18", "--spp", "1"), "build": (),
    "bench queries": ("--number", "200", "--runs", "1", "--worlds", "2"),
}
SLOW = {  # run by `pytest -m slow`
    "whatif": ("--rays", "200", "--kinds", "primary"),
    "stability": ("--rays", "200", "--sample", "50", "--runs", "1"), "bench rtcore": ("--rays", "500",),
    "bench error": ("--size", "16x9", "--max-spp", "2", "--repeats", "3", "--reference-spp", "4", "--knobs", "max_depth"),
    "bench visibility": ("--size", "64", "--max-size", "64", "--max-triangles", "2000", "--runs", "1"),
    "bench claims": ("--side", "16", "cwbvh"),
    "bench mitsuba": ("--size", "16x9", "--spp", "1", "--repeats", "3", "--starts", "0"),
}


def test_a_version_has_at_most_thirty_lines_of_changes() -> None:
    versions = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8").split("\n## ")[1:]
    assert versions and all(len(text.splitlines()) <= 31 for text in versions)  # with the heading


def page_id(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


# --- command lines ----------------------------------------------------------------------------------------------------


def command_lines(text: str) -> list[str]:
    """Return the commands in shell blocks, and in text between backquotes that begins with `wrt` or `python -m wrt`."""
    blocks = re.findall(r"^```(?:sh|bash|console)\n(.*?)^```", text, re.DOTALL | re.MULTILINE)
    prose = re.sub(r"^```.*?^```", "", text, flags=re.DOTALL | re.MULTILINE)
    spans = [re.sub(r"\s+", " ", span) for span in re.findall(r"`([^`]+)`", prose)]
    lines = [line for block in blocks for line in block.replace("\\\n", " ").splitlines()]
    lines += [span for span in spans if re.match(r"(python -m )?wrt [a-z]", span)]
    return [part.strip() for line in lines for part in re.split(r"&&|;", re.sub(r"(^|\s)#.*", "", line)) if part.strip()]


def arguments(line: str) -> list[str] | None:
    """Return the arguments of `python -m wrt`, or None if the line is another command."""
    match = re.fullmatch(r"(?:python -m )?wrt ([a-z].*)", line)
    if match is None:
        return None
    out: list[str] = []
    for word in shlex.split(re.sub(r"[\[\]]", "", match[1])):
        found = [STANDS_FOR.get(word, word)]
        if "*" in word:
            found = [str(path.relative_to(ROOT)) for path in sorted(ROOT.glob(word))][:3]
        out += found
    return out


def command_of(words: list[str]) -> tuple[str, click.Command]:
    name, command = words[0], cli.commands[words[0]]
    if isinstance(command, click.Group) and words[1] in command.commands:
        name, command = f"{words[0]} {words[1]}", command.commands[words[1]]
    return name, command


LINES = sorted({(page_id(page), line) for page in PAGES for line in command_lines(page.read_text(encoding="utf-8"))})
COMMANDS = [(page, line) for page, line in LINES if arguments(line) is not None]


def test_there_are_command_lines() -> None:
    assert len(COMMANDS) >= 25 and {page for page, _ in COMMANDS} >= {"README.md", "docs/viewer.md", "docs/rt_core.md"}
    shown = {command_of(arguments(line) or [])[0] for _, line in COMMANDS}
    assert shown - CHEAP.keys() - SLOW.keys() == {"view"}  # `view` waits for a browser; tests/wrt/viewer/test_page.py runs it
    known = {name for name, command in cli.commands.items() if not isinstance(command, click.Group)}
    assert known <= shown  # no command is left out of the documentation


@pytest.mark.parametrize(("page", "line"), [each for each in LINES if each not in COMMANDS])
def test_other_commands_are_those_of_installing_and_testing(page: str, line: str) -> None:
    assert line.startswith(OTHERS), f"{page}: {line}"


@pytest.mark.parametrize(("page", "line"), COMMANDS)
def test_a_command_line_is_valid(page: str, line: str) -> None:
    """The command and its options exist, and their values have the right types."""
    words = arguments(line) or []
    name, command = command_of(words)
    try:
        # The group's settings add -h to the help option, which click creates once and caches; other tests in this process use -h.
        command.make_context(name, words[len(name.split()) :], resilient_parsing=False, **cli.context_settings)
    except click.exceptions.MissingParameter:
        assert re.fullmatch(r"(python -m )?wrt [a-z ]+", line), f"{page}: {line}"  # text may name a command without its arguments


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with the files that command lines name: the scenes, a mesh, a glTF file with three cameras, two pictures."""
    folder = tmp_path_factory.mktemp("documentation")
    shutil.copytree(ROOT / "scenes", folder / "scenes")
    shutil.copy(ROOT / "scenes" / "whitted.toml", folder / "scene.toml")
    (folder / "box.obj").write_text(BOX_OBJ, encoding="utf-8")
    box = load_mesh(folder / "box.obj")
    write_ply(folder / "model.ply", box.vertices, box.faces)
    gltf = GltfFile()
    camera = gltf.add("cameras", {"type": "perspective", "perspective": {"yfov": 0.7, "znear": 0.1}})
    for i in range(3):
        gltf.node(camera=camera, translation=[0.2 * i, 0.1, 6.0])
    gltf.node(mesh=gltf.mesh(gltf.primitive(box.vertices, box.faces.ravel())))
    gltf.write(folder, "model.glb")
    from wrt.picture.image import write_image

    for name in ("a.exr", "b.exr"):
        write_image(folder / name, np.full((18, 32, 3), 0.25, np.float32))
    return folder


def write_ply(path: Path, vertices: np.ndarray, faces: np.ndarray) -> None:
    head = (f"ply\nformat ascii 1.0\nelement vertex {len(vertices)}\nproperty float x\nproperty float y\nproperty float z\n"
            f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n")
    rows = [" ".join(map(str, vertex)) for vertex in vertices] + [f"3 {' '.join(map(str, face))}" for face in faces]
    path.write_text(head + "\n".join(rows) + "\n", encoding="ascii")


def runs(commands: dict[str, tuple[str, ...]]) -> list[tuple[str, ...]]:
    """Return the distinct argument lists of the command lines that are complete, with the options of `commands` appended."""
    out = set()
    for line in {line for page, line in COMMANDS if page != "CHANGELOG.md"}:
        words = arguments(line) or []
        name, command = command_of(words)
        needs = any(isinstance(each, click.Argument) for each in command.params)
        if name in commands and (len(words) > len(name.split()) or not needs):
            out.add((*words, *commands[name]))
    return sorted(out)


@pytest.mark.parametrize("words", runs(CHEAP), ids=" ".join)
def test_a_command_line_runs(words: tuple[str, ...], folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shutil.copytree(folder, tmp_path / "here")
    monkeypatch.chdir(tmp_path / "here")
    if "--accel" in words and "runs" in words:
        pytest.skip("the structure of docs/extending.md: tests/test_extending.py runs it")
    if words[0] == "profile":
        Path(words[1]).write_text(MIRRORS, encoding="utf-8")  # a scene whose counting kernel other tests compile, too
    if "--cluster" in words or any("cuda" in word for word in words):
        pytest.skip("needs a scheduler (test_dask.py has one), or GPUs")
    if "--check" in words:  # tests/test_bits.py compares the other scenes
        monkeypatch.setattr("wrt.lab.device_check.MESHES", {"ball": icosphere})
        words = (*words, "--scene", "scenes/whitted.toml")
    result = run(*words)
    assert result.code == 0, result.err


@pytest.mark.slow
@pytest.mark.parametrize("words", runs(SLOW), ids=" ".join)
def test_a_slow_command_line_runs(words: tuple[str, ...], folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    test_a_command_line_runs(words, folder, tmp_path, monkeypatch)


# --- Python -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("page", ["README.md", "docs/usage.md", "docs/compat.md", "docs/gradients.md", "docs/long_renders.md",
                                  "docs/sensors.md", "docs/testing.md"])
def test_python_runs(page: str, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import wrt

    shutil.copytree(folder, tmp_path / "here")
    monkeypatch.chdir(tmp_path / "here")
    scene = wrt.load_scene("scene.toml").with_settings(size=(24, 14))
    rays = np.tile(np.array([0.1, 0.2, 5.0], np.float32), (3, 1)), np.tile(np.array([0.0, 0.0, -1.0], np.float32), (3, 1))
    names: dict[str, Any] = {"wrt": wrt, "scene": scene, "origins": rays[0], "directions": rays[1], "camera": scene.camera()}
    if page == "README.md":
        names = {}  # the example needs only a checkout
    blocks = re.findall(r"^```python\n(.*?)^```", (ROOT / page).read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)
    assert blocks
    for i, block in enumerate(blocks):
        cheap = re.sub(r"spp=\d+", "spp=2", block).replace("640x360", "24x14").replace("(640, 360)", "(24, 14)")
        cheap = cheap.replace('"bunny.ply"', '"model.ply"').replace("progress=lambda", "spp=1, size=(24, 14), progress=lambda")
        file = tmp_path / f"block_{i}.py"  # Warp reads the source of kernels
        file.write_text(cheap, encoding="utf-8")
        exec(compile(cheap, file, "exec"), names)


def calls(theirs: str) -> list[tuple[str, str]]:
    """Return the code of both columns of the table of docs/compat.md whose first head begins with `theirs`, from the cells of each row."""
    text = (ROOT / "docs" / "compat.md").read_text(encoding="utf-8")
    table = re.search(rf"^\| {theirs}[^|]*\| the same in wrt \|\n\|---\|---\|\n((?:\|.*\n)+)", text, re.MULTILINE)
    assert table, theirs
    cells = [(row.strip("| ").split(" | ")) for row in table[1].splitlines()]
    return [("\n".join(re.findall("`([^`]+)`", a)), "\n".join(re.findall("`([^`]+)`", b))) for a, b in cells]


@pytest.mark.parametrize("theirs", ["trimesh", "Open3D", "Embree 4", "Mitsuba 3"])
def test_calls_in_the_tables_for_other_libraries_run(theirs: str, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """wrt's calls of a table run in the order of the rows; trimesh's calls run, too, and arrays of both agree."""
    import trimesh

    import wrt

    shutil.copytree(folder, tmp_path / "here")
    monkeypatch.chdir(tmp_path / "here")
    ball = icosphere(2)
    origins = np.random.default_rng(0).uniform(-0.5, 0.5, (50, 3)) + (0, 0, 5)
    directions = np.tile((0.0, 0.0, -1.0), (50, 1))
    names: dict[str, Any] = {
        "np": np, "wrt": wrt, "mesh": ball, "vertices": ball.vertices, "faces": ball.faces, "moved": ball.vertices, "points": origins,
        "origins": origins, "directions": directions, "rays": np.concatenate([origins, directions], axis=1), "pose": np.eye(4),
        "K": np.diag([500.0, 500.0, 1.0]), "colors": np.zeros((10_000, 3)), "scene": wrt.Scene.of([ball, ball]),
        "trimesh_mesh": ball.to_trimesh(), "matrix": np.eye(4), "locations": origins, "index_ray": np.arange(50),
        "theirs": np.zeros((640 * 480, 3)),
        "query": wrt.ray_query("bvh")}
    theirs_names = {**names, "trimesh": trimesh, "mesh": ball.to_trimesh(), "scene": trimesh.Scene(ball.to_trimesh())}
    names["accel"] = wrt.build(ball)
    run_lines, agree = 0, 0
    for call, ours in calls(theirs):
        code = ours.replace('"bunny.ply"', '"model.ply"').replace("spp=64", "spp=1, size=(16, 9)").replace(", size=(640, 360)", "")
        lines = [line for line in code.splitlines() if line != 'device="cuda:0"']
        run_lines += len(lines)
        result = [value_of(line, names) for line in lines][-1:]
        if theirs == "trimesh":
            call = re.sub(r"(trimesh\.proximity\.\w+)\(.*", r"\1", call)  # trimesh needs rtree to run these
            other = [value_of(line, theirs_names) for line in call.replace('"bunny.ply"', '"model.ply"').splitlines()]
            if other and isinstance(other[0], np.ndarray) and other[0].shape == np.shape(result[0]):
                np.testing.assert_allclose(result[0], other[0], atol=1e-5)
                agree += 1
    assert run_lines > 12 and agree >= (3 if theirs == "trimesh" else 0)


def test_the_table_for_trimesh_makes_the_rays_of_its_camera() -> None:
    import trimesh

    import wrt

    camera = trimesh.scene.Camera(resolution=(640, 480), fov=(60.0, 45.0))
    pose = trimesh.transformations.rotation_matrix(0.7, [1.0, 2.0, 3.0])
    pose[:3, 3] = 1.0, 2.0, 3.0

    def difference(row: str) -> float:
        """Return the largest difference of a unit direction. A line of the row reorders trimesh's directions."""
        origins, theirs, _ = trimesh.Scene(trimesh.creation.box(), camera=camera, camera_transform=pose).camera_rays()
        names: dict[str, Any] = {"np": np, "wrt": wrt, "K": camera.K, "pose": pose}
        code = next(ours for call, ours in calls("trimesh") if row in call).replace("fov_y=0.6", f"fov_y={np.radians(camera.fov[1])}")
        names["theirs"] = theirs
        values = [value_of(line, names) for line in code.splitlines()]
        if isinstance(values[-1], tuple):
            (ours, directions), reordered = values[-1], theirs.reshape(640, 480, 3).transpose(1, 0, 2).reshape(-1, 3)
        else:
            ours, directions, reordered = values[-3:]
        np.testing.assert_allclose(ours, origins, atol=1e-6)
        length = np.linalg.norm(directions, axis=1, keepdims=True)
        assert np.allclose(length, 1.0, atol=1e-6) == (row == "scene.camera.fov")
        return float(np.abs(directions / length - reordered).max())

    assert difference("scene.camera_rays()") < 2e-7
    camera.fov = 60.0, np.degrees(2.0 * np.arctan(0.75 * np.tan(np.radians(30.0))))
    assert max(difference("scene.camera_rays()"), difference("scene.camera.fov")) < 2e-7


def value_of(line: str, names: dict[str, Any]) -> Any:
    """Run a line of Python and return its value, None for a statement."""
    if re.match(r"\w+ = |[\w.]+ = ", line):
        return exec(line, names)
    return eval(line, names)


# --- the API reference ------------------------------------------------------------------------------------------------


def functions_of(thing: Any) -> Iterator[tuple[str, Any]]:
    """Yield the public methods and properties that a class defines itself."""
    for name, value in vars(thing).items():
        function = value.fget if isinstance(value, property) else getattr(value, "__func__", value)
        if not name.startswith("_") and inspect.isfunction(function):
            yield name, function


@pytest.mark.parametrize("module", ["wrt", "wrt.accel.base", "wrt.accel.queries.answers", "wrt.accel.geometry",
                                    "wrt.accel.scenes.build", "wrt.accel.queries.gradients", "wrt.accel.instances",
                                    "wrt.compat.open3d", "wrt.compat.trimesh", "wrt.torch", "wrt.jax", "wrt.sensors",
                                    "wrt.testing"])
def test_everything_public_has_a_docstring(module: str) -> None:
    silent = []
    public = importlib.import_module(module)
    own = [name for name, thing in vars(public).items() if not name.startswith("_") and getattr(thing, "__module__", "") == module]
    for name in set(getattr(public, "__all__", own)) - {"__version__"}:
        thing = getattr(public, name)
        if not thing.__doc__ or thing.__doc__.startswith(f"{name}("):  # the docstring that dataclasses generate
            silent.append(name)
        if inspect.isclass(thing):
            silent += [f"{name}.{each}" for each, _ in functions_of(thing) if not inspect.getdoc(vars(thing)[each])]
    assert silent == []


# --- plots ------------------------------------------------------------------------------------------------------------

PLOTS = ROOT / "docs" / "plots"


@pytest.fixture(scope="module")
def plots() -> dict[str, Any]:
    return runpy.run_path(str(PLOTS / "make.py"))


def test_plots_show_the_data_beside_them(plots: dict[str, Any]) -> None:
    """`python docs/plots/make.py` changes no file, a page shows each plot, and each CSV file says how to measure its data."""
    drawn = {f"{plot.__name__}.svg": plot() for plot in plots["PLOTS"]}
    assert drawn == {file.name: file.read_text(encoding="utf-8") for file in PLOTS.glob("*.svg")}
    pages = "".join(page.read_text(encoding="utf-8") for page in PAGES)
    assert [name for name in drawn if f"plots/{name})" not in pages] == []
    for file in PLOTS.glob("*.csv"):
        comments = [line for line in file.read_text(encoding="utf-8").splitlines() if line.startswith("#")]
        assert any(re.match(r"# (command|method): ", line) for line in comments), file.name


def cells(page: str, row: str) -> list[str]:
    """Return the cells behind the first of the table row that begins with `row`, without stars and thousands separators."""
    text = re.sub(r"[*,]", "", (ROOT / "docs" / page).read_text(encoding="utf-8"))
    line = re.search(rf"^\| {re.escape(row.replace(',', ''))}\b[^|]*\|(.*)\|$", text, re.MULTILINE)
    assert line, f"{page}: {row}"
    return line[1].split("|")


def test_tables_have_the_sums_and_means_of_the_data(plots: dict[str, Any]) -> None:
    """The tables of performance.md have geometric means of the speeds; those of accuracy.md and testing.md sums of wrong rays."""
    speeds, groups, libraries = (plots["read"](name) for name in ("peers", "hard_cases", "libraries"))
    for row, rival in (("Embree robust, best mode", "embree_best"), ("Embree robust, one", "embree_robust"),
                       ("Embree fast", "embree_fast"), ("Warp's mesh query", "warp")):
        means = [geometric_mean([float(line[rival]) for line in speeds if line["rays"] == kind])
                 for kind in ("primary", "shadow", "diffuse", "random")]
        assert [float(cell) for cell in cells("performance.md", row)] == pytest.approx(means, abs=0.006)
    for row, test, rays in (("Moeller-Trumbore", "moeller_trumbore", "sample"), ("Embree robust", "embree_robust", "peer_sample"),
                            ("Embree fast", "embree_fast", "peer_sample"), ("Warp's mesh query", "warp", "peer_sample")):
        sums = [sum(int(line[name]) for line in groups if line["group"] != "I") for name in (test, rays)]
        assert [int(cell) for cell in cells("accuracy.md", row)[:2]] == sums
    for row, library in (("wrt", "wrt"), ("Embree robust", "embree_robust"), ("Embree fast", "embree_fast"), ("Open3D", "open3d"),
                         ("Warp", "warp"), ("Mitsuba", "mitsuba"), ("trimesh", "trimesh")):
        rays = "trimesh_rays" if library == "trimesh" else "rays"
        sums = [sum(int(line[name]) for line in libraries if ": " in line["name"]) for name in (library, rays)]
        assert [int(cell) for cell in cells("testing.md", row)][:2] == sums


# --- links ------------------------------------------------------------------------------------------------------------


def anchors(path: Path) -> set[str]:
    """Return the anchors of a page's headings, as GitHub makes them."""
    text = re.sub(r"^```.*?^```", "", path.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)
    titles = re.findall(r"^#+ (.*)$", text, re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


@pytest.mark.parametrize("page", PAGES + NOTES, ids=page_id)
def test_links_lead_somewhere(page: Path) -> None:
    text = re.sub(r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)
    for target in re.findall(r"\]\(([^)\s]+)\)", text):
        if re.match(r"[a-z]+://", target):
            continue
        path, _, anchor = target.partition("#")
        file = (page.parent / path).resolve() if path else page
        assert file.exists() and file.is_relative_to(ROOT), f"{page.name}: {target}"
        assert not anchor or anchor in anchors(file), f"{page.name}: {target}"


@pytest.mark.parametrize("file", ["README.md", "units/triangle.py", "units/box.py", "loops/one_ray.py", "loops/wave.py"])
def test_the_device_code_names_files_that_exist(file: str) -> None:
    """Files and tests that a README or a docstring of device code names exist."""
    text = (ROOT / "kernels" / file).read_text(encoding="utf-8")
    if file.endswith(".py"):
        text = ast.get_docstring(ast.parse(text)) or ""
    named = set(re.findall(r"(?<![\w./*])[\w*][\w/*]*\.(?:py|h|md)\b", text))
    assert any(name.startswith("tests/") for name in named)
    places = [ROOT, ROOT / "wrt" / "accel" / "queries", ROOT / "kernels", *(ROOT / "kernels").iterdir()]
    for name in named:
        assert any(any(folder.glob(name)) for folder in places), name


def test_the_lecture_names_headings_and_files_that_exist() -> None:
    lines = (ROOT / "docs" / "lecture.md").read_text(encoding="utf-8").splitlines()
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines if line.startswith("| ")][1:]
    assert len(rows) > 20
    for topic, place, file, _ in rows:
        notebook, heading = re.sub(r"\[(\w+)\]\([^)]*\)", r"\1", place).split(": ")
        source = (ROOT / "notebooks" / f"{notebook}.py").read_text(encoding="utf-8")
        assert re.search(rf"^# ##+ {re.escape(heading)}", source, re.MULTILINE), topic
        assert not file or (ROOT / "kernels" / file.strip("`")).exists(), topic


def test_every_page_is_reached_from_the_readme() -> None:
    reached, new = set(), [ROOT / "README.md"]
    while new:
        page = new.pop()
        reached.add(page)
        links = re.findall(r"\]\(([^)#\s]+\.md)[^)]*\)", page.read_text(encoding="utf-8"))
        new += [file for link in links if (file := (page.parent / link).resolve()) not in reached and file.exists()]
    assert {page for page in PAGES + NOTES if page.name != "CHANGELOG.md"} <= reached
