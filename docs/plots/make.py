"""Draw the plots of README.md and docs/ from the CSV files beside this script: `python docs/plots/make.py`.

Needs Python alone. Equal data give equal bytes; `tests/test_documentation.py` compares the drawings with the files.
Text is large enough to be read where a page is 400 pixels wide.
"""

from __future__ import annotations

import csv
import itertools
import math
from html import escape
from pathlib import Path
from statistics import geometric_mean

HERE = Path(__file__).resolve().parent
WIDTH = 640
COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")  # Okabe and Ito: safe for colour-blind readers
SHAPES = ("circle", "square", "diamond", "triangle", "circle", "square", "diamond")
FONT = 21
PEERS = ("embree_robust", "embree_fast", "warp")
Table = list[dict[str, str]]


def read(name: str) -> Table:
    """Return the rows of a CSV file; lines that begin with # say how they were measured."""
    lines = (HERE / f"{name}.csv").read_text(encoding="utf-8").splitlines()
    return list(csv.DictReader(line for line in lines if not line.startswith("#")))


class Drawing:
    """An SVG picture, WIDTH wide, on a white ground."""

    def __init__(self, title: str, height: float):
        self.title, self.height, self.parts = title, height, list[str]()

    def text(self, x: float, y: float, text: str, *, anchor: str = "start", size: float = FONT, color: str = "#222",
             bold: bool = False, turn: float = 0) -> None:
        extra = (' font-weight="bold"' if bold else "") + (f' transform="rotate({turn:g} {x:.1f} {y:.1f})"' if turn else "")
        self.parts.append(f'<text x="{x:.1f}" y="{y:.1f}" font-size="{size:g}" text-anchor="{anchor}" fill="{color}"{extra}>'
                          f"{escape(text)}</text>")

    def line(self, x0: float, y0: float, x1: float, y1: float, color: str = "#ddd", width: float = 1.5, dash: str = "") -> None:
        self.parts.append(f'<line x1="{x0:.1f}" y1="{y0:.1f}" x2="{x1:.1f}" y2="{y1:.1f}" stroke="{color}" stroke-width="{width:g}"'
                          + (f' stroke-dasharray="{dash}"' if dash else "") + "/>")

    def box(self, x: float, y: float, width: float, height: float, color: str) -> None:
        self.parts.append(f'<rect x="{x:.1f}" y="{y:.1f}" width="{width:.1f}" height="{height:.1f}" fill="{color}"/>')

    def mark(self, x: float, y: float, series: int, size: float = 7) -> None:
        color, shape = COLORS[series], SHAPES[series]
        if shape == "circle":
            self.parts.append(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{size:g}" fill="{color}" fill-opacity="0.8"/>')
            return
        corners = {"square": ((-1, -1), (1, -1), (1, 1), (-1, 1)), "diamond": ((0, -1.3), (1.3, 0), (0, 1.3), (-1.3, 0)),
                   "triangle": ((0, -1.3), (1.2, 1), (-1.2, 1))}[shape]
        points = " ".join(f"{x + size * 0.9 * i:.1f},{y + size * 0.9 * j:.1f}" for i, j in corners)
        self.parts.append(f'<polygon points="{points}" fill="{color}" fill-opacity="0.8"/>')

    def legend(self, names: list[str], y: float, x: float = 12) -> float:
        """Draw the series' names in as many lines as they need; return y below them."""
        left = x
        for i, name in enumerate(names):
            width = 34 + 0.56 * FONT * len(name)
            if left + width > WIDTH and left > x:
                left, y = x, y + 30
            self.mark(left + 8, y - 7, i)
            self.text(left + 22, y, name)
            left += width
        return y + 30

    def svg(self) -> str:
        return (f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {self.height:g}" width="{WIDTH}" height="{self.height:g}"'
                f' role="img" font-family="Helvetica, Arial, sans-serif">\n<title>{escape(self.title)}</title>\n'
                f'<rect width="{WIDTH}" height="{self.height:g}" fill="#fff"/>\n' + "\n".join(self.parts) + "\n</svg>\n")


class Scale:
    """Values to pixels, linear or logarithmic."""

    def __init__(self, low: float, high: float, start: float, end: float, log: bool = False):
        self.convert = math.log10 if log else float
        self.low, self.high, self.start, self.end = self.convert(low), self.convert(high), start, end

    def __call__(self, value: float) -> float:
        return self.start + (self.convert(value) - self.low) / (self.high - self.low) * (self.end - self.start)


def dots(title: str, rows: list[tuple[str, list[tuple[float, int]]]], series: list[str], ticks: list[float], axis: str, *,
         low: float | None = None, log: bool = False, labels: float = 210, mean: bool = False, one: bool = False) -> str:
    """Draw a line for each row, with a mark for each (value, series).

    A row without values is a heading. The axis begins at `low`, by default the first tick. `mean` adds the geometric mean as a
    bar with its number, and `one` a line at 1.
    """
    height = 36
    drawing = Drawing(title, 0)
    drawing.text(12, 30, title, bold=True)
    top = drawing.legend(series, 66) - 12 if series else 48
    scale = Scale(low or ticks[0], ticks[-1], labels, WIDTH - (76 if mean else 40), log)
    bottom = top + height * len(rows) + 6
    for tick in ticks:
        drawing.line(scale(tick), top, scale(tick), bottom)
        drawing.text(scale(tick), bottom + 24, f"{tick:g}", anchor="middle", size=19)
    if one:
        drawing.line(scale(1), top, scale(1), bottom, "#222", 2)
    for i, (label, values) in enumerate(rows):
        y = top + height * (i + 0.5) + 3
        if not values:
            drawing.text(12, y + 7, label, bold=True)
            continue
        drawing.text(labels - 12, y + 7, label, anchor="end")
        for value, which in values:
            drawing.mark(scale(value), y, which)
        if mean:
            middle = geometric_mean([value for value, _ in values])
            drawing.line(scale(middle), y - 14, scale(middle), y + 14, "#222", 4)
            drawing.text(WIDTH - 10, y + 7, f"{middle:.2f}", anchor="end", bold=True)
    drawing.text((labels + WIDTH) / 2, bottom + 54, axis, anchor="middle", size=19)
    drawing.height = bottom + 68
    return drawing.svg()


def peers() -> str:
    table = read("peers")
    meshes = list(dict.fromkeys(row["mesh"] for row in table))
    rivals = {"embree_best": "Embree, best mode", "embree_robust": "Embree robust", "embree_fast": "Embree fast", "warp": "Warp"}
    rows: list[tuple[str, list[tuple[float, int]]]] = []
    for kind in ("primary", "shadow", "diffuse", "random"):
        rows.append((f"{kind} rays", []))
        for rival, name in rivals.items():
            rows.append((name, [(float(row[rival]), meshes.index(row["mesh"])) for row in table if row["rays"] == kind]))
    return dots("Times as fast as the rival, one thread", rows, meshes, [1, 2, 4, 8, 16], "the bar and the number: geometric mean",
                low=0.9, log=True, mean=True, one=True)


def queries() -> str:
    """Draw a bar for each kind of ray and each library in its best mode; the time is a geometric mean over the meshes."""
    names = {"bvh8": "wrt", "tinybvh": "tinybvh", "embree": "Embree robust", "embree:mode=fast": "Embree fast", "open3d": "Open3D",
             "trimesh": "trimesh", "warp": "Warp"}
    best: dict[tuple[str, str], dict[str, float]] = {}
    for row in read("queries"):
        modes = best.setdefault((row["kind"], row["library"]), {})
        modes[row["mesh"]] = min(float(row["ns"]), modes.get(row["mesh"], math.inf))
    kinds = {"primary": "primary rays", "shadow": "any hit: shadow rays", "diffuse": "bounce: diffuse rays", "random": "random rays"}
    times = {key: geometric_mean(modes.values()) for key, modes in best.items() if key[0] in kinds}
    drawing, y, left = Drawing("Nanoseconds a ray, one thread", 0), 48.0, 180
    drawing.text(12, 30, "Nanoseconds a ray, one thread: less is better", bold=True)
    scale = Scale(0, max(times.values()), left, WIDTH - 70)
    for kind, title in kinds.items():
        drawing.text(left, y + 22, title, bold=True)
        y += 30
        for library, name in names.items():
            if (kind, library) in times:
                time = times[kind, library]
                drawing.text(left - 10, y + 20, name, anchor="end", size=19)
                drawing.box(left, y + 3, scale(time) - left, 20, COLORS[0] if name == "wrt" else "#aaa")
                drawing.text(scale(time) + 8, y + 20, f"{time:.0f}", size=19, bold=name == "wrt")
                y += 26
        y += 8
    drawing.height = y + 4
    return drawing.svg()


def speed_and_error() -> str:
    speeds, errors = read("peers"), read("hard_cases")

    def ratios(rival: str) -> list[float]:
        """Return the speed over robust Embree for each kind of ray, a geometric mean of the meshes; wrt's if `rival` is empty."""
        kinds: dict[str, list[float]] = {}
        for row in speeds:
            kinds.setdefault(row["rays"], []).append(float(row["embree_robust"]) / float(row[rival] if rival else 1))
        return [geometric_mean(values) for values in kinds.values()]

    def wrong(test: str) -> float:
        rows = [row for row in errors if row["group"] != "I"]
        return 100 * sum(int(row[test]) for row in rows) / sum(int(row["peer_sample"]) for row in rows)

    drawing = Drawing("Speed against error", 470)
    drawing.text(12, 30, "Speed over robust Embree, against wrong rays", bold=True)
    x, y = Scale(0, 16, 40, WIDTH - 24), Scale(0, 3.5, 390, 60)
    for tick in (0, 4, 8, 12, 16):
        drawing.line(x(tick), y(0), x(tick), y(3.5))
        drawing.text(x(tick), y(0) + 26, f"{tick} %" if tick else "0", anchor="middle", size=19)
    for tick in (0, 1, 2, 3):
        drawing.line(x(0), y(tick), x(16), y(tick))
        drawing.text(x(0) - 10, y(tick) + 7, f"{tick}", anchor="end", size=19)
    packets = geometric_mean(ratios("embree_best"))  # their errors were not measured
    drawing.line(x(0), y(packets), x(16), y(packets), COLORS[1], 2.5, dash="7 6")
    drawing.text(x(16) - 8, y(packets) - 8, "Embree robust, packets where faster", anchor="end", size=19, color=COLORS[1])
    for i, (label, name, side) in enumerate((("wrt", "", 1), ("Embree robust", "embree_robust", 1), ("Embree fast", "embree_fast", 1),
                                             ("Warp", "warp", -1))):
        values = ratios(name)
        across, middle = x(wrong(name or "watertight")), geometric_mean(values)
        drawing.line(across, y(min(values)), across, y(max(values)), COLORS[i], 5)
        drawing.mark(across, y(middle), i, 10)
        drawing.text(across + 18 * side, y(middle) + 7, label, anchor="start" if side > 0 else "end", color=COLORS[i], bold=True)
    drawing.text(WIDTH / 2, 448, "hard-case rays lost, invented or given to a wrong triangle", anchor="middle", size=19)
    drawing.text(x(16) - 8, 84, "the mark: mean of four kinds of ray;", anchor="end", size=19)
    drawing.text(x(16) - 8, 108, "the line: slowest to fastest kind", anchor="end", size=19)
    return drawing.svg()


def heat(title: str, rows: list[tuple[str, list[float]]], columns: list[str], left: float) -> str:
    """Draw percentages as cells, the darker the larger, on a logarithmic scale from 0.01 to 40; a line without cells is a gap."""
    top, height = 186, 40
    drawing = Drawing(title, top + height * len(rows) + 36)
    drawing.text(12, 30, title, bold=True)
    width = (WIDTH - 26 - left) / len(columns)
    for j, name in enumerate(columns):
        drawing.text(left + width * (j + 0.5) + 4, top - 10, name, turn=-50, size=18)
    for i, (label, shares) in enumerate(rows):
        y = top + height * i
        drawing.text(12, y + 27, label, size=19)
        for j, share in enumerate(shares):
            depth = min(max(math.log10(share / 0.01) / math.log10(40 / 0.01), 0.0), 1.0) if share else 0.0
            color = tuple(round(a + (b - a) * depth) for a, b in zip((255, 240, 226), (165, 30, 10), strict=True))
            fill = "#" + "".join(f"{each:02x}" for each in color) if share else "#dcefe3"
            drawing.box(left + width * j + 1, y + 1, width - 2, height - 2, fill)
            digits = 0 if share >= 9.95 or not share else 1 if share >= 0.095 else 2
            drawing.text(left + width * (j + 0.5), y + 27, f"{share:.{digits}f}", anchor="middle", size=19,
                         color="#fff" if depth > 0.6 else "#222", bold=not share)
    drawing.text(12, drawing.height - 10, "darker: more rays lost, invented or given to a wrong triangle", size=18)
    return drawing.svg()


def hard_cases() -> str:
    tests = {"watertight": "wrt default", "moeller_trumbore": "Moeller-Trumbore", "baldwin_weber": "Baldwin-Weber",
             "plane": "plane equation", "embree_robust": "Embree robust", "embree_fast": "Embree fast", "warp": "Warp"}
    rows = [(f"{row['group']}: {row['what'].split(',')[0]}",
             [100 * int(row[test]) / int(row["peer_sample" if test in PEERS else "sample"]) for test in tests])
            for row in read("hard_cases")]
    return heat("Wrong rays in each group, percent", rows, list(tests.values()), 236)


def libraries() -> str:
    names = {"wrt": "wrt", "embree_robust": "Embree robust", "embree_fast": "Embree fast", "open3d": "Open3D", "warp": "Warp",
             "mitsuba": "Mitsuba", "trimesh": "trimesh"}
    rows = [(row["name"], [100 * int(row[name]) / int(row["trimesh_rays" if name == "trimesh" else "rays"]) for name in names])
            for row in read("libraries")]
    return heat("Wrong rays by library, percent", [*rows[:9], ("", []), *rows[9:]], list(names.values()), 252)


def default_cost() -> str:
    table = read("default_cost")
    names = {"moeller_trumbore": "Moeller-Trumbore", "baldwin_weber": "Baldwin-Weber", "plane": "plane equation",
             "minmax": "min-max boxes", "plain": "plain boxes"}
    rows = [(name, [(float(row[test]), int(row["rays"] == "random")) for row in table if row[test]]) for test, name in names.items()]
    return dots("Time of the default over other tests'", rows, ["primary", "random"], [0.9, 1, 1.1, 1.2],
                "right of 1: the other test is faster", one=True, mean=True)


def mitsuba() -> str:
    table = read("mitsuba")
    variants = {"scalar_rgb": 0, "llvm_ad_rgb": 1}
    rows = []
    for scene in dict.fromkeys(row["scene"] for row in table):
        for part in ("tracing", "whole"):
            values = [(float(row["ratio"]), variants[row["variant"]]) for row in table if (row["scene"], row["part"]) == (scene, part)]
            rows.append((f"{scene.removesuffix('.toml')}, {part}", values))
    return dots("Mitsuba 3's time to wrt's error, over wrt's", rows, list(variants), [1, 3, 10, 30, 100, 300],
                "right of 1: wrt is faster", low=0.4, log=True, one=True, labels=200)


def pictures() -> str:
    rows = [(row["scene"].removesuffix(".toml"), [(float(row[name]), i) for i, name in enumerate(("batches", "two_threads")) if row[name]])
            for row in read("pictures")]
    return dots("Tracing of whole pictures: times as fast", rows, ["many samples at a time", "two threads"], [1, 2, 3, 4],
                "over one sample at a time; over one thread", labels=230)


def structures() -> str:
    table = [row for row in read("structures") if " " not in row["structure"]]
    meshes = ["legocar", "bunny", "sponza", "dragon"]
    rows = [(row["structure"], [(float(row[mesh]), i) for i, mesh in enumerate(meshes) if row[mesh]]) for row in table]
    return dots("Steps of a random line (SAH cost)", rows, meshes, [10, 20, 50, 100, 250], "inner nodes and triangles; less is better",
                log=True, labels=150)


def builders() -> str:
    table = read("builders")
    meshes = ["bunny", "sponza", "conference", "dragon"]
    rows = []
    for name in dict.fromkeys(row["builder"] for row in table):
        rows.append((name, [(float(row["nodes"]) + float(row["triangles"]), meshes.index(row["mesh"])) for row in table
                            if row["builder"] == name]))
    return dots("Steps a ray by builder (bvh2)", rows, meshes, [12, 14, 16, 18, 20], "nodes and triangles fetched; less is better",
                labels=150)


def refit() -> str:
    table = read("refit")
    drawing = Drawing("Steps a ray as the bunny is twisted", 430)
    drawing.text(12, 30, "Steps a ray as the bunny is twisted", bold=True)
    drawing.legend(["refitted tree", "new tree"], 66)
    x, y = Scale(0, 1, 66, WIDTH - 40), Scale(0, 60, 350, 84)
    for tick in (0, 0.25, 0.5, 0.75, 1):
        drawing.line(x(tick), y(0), x(tick), y(60))
        drawing.text(x(tick), y(0) + 26, f"{tick:g}", anchor="middle", size=19)
    for tick in (0, 20, 40, 60):
        drawing.line(x(0), y(tick), x(1), y(tick))
        drawing.text(x(0) - 10, y(tick) + 7, f"{tick}", anchor="end", size=19)
    for i, kind in enumerate(("refit", "new")):
        points = [(x(float(row["turns"])), y(float(row[f"{kind}_nodes"]) + float(row[f"{kind}_triangles"]))) for row in table]
        for (x0, y0), (x1, y1) in itertools.pairwise(points):
            drawing.line(x0, y0, x1, y1, COLORS[i], 4)
        for point in points:
            drawing.mark(*point, i, 8)
    drawing.text(WIDTH / 2, 410, "turns from bottom to top", anchor="middle", size=19)
    return drawing.svg()


PLOTS = (speed_and_error, peers, queries, hard_cases, libraries, default_cost, mitsuba, pictures, structures, builders, refit)


def main() -> None:
    for plot in PLOTS:
        (HERE / f"{plot.__name__}.svg").write_text(plot(), encoding="utf-8", newline="\n")


if __name__ == "__main__":
    main()
