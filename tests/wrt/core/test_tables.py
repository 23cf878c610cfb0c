"""Tables of hits and fetches as files: every number keeps its bits."""

import csv

import numpy as np
import pytest

import wrt
from wrt.core.tables import write_table
from wrt.lab.rtcore.trace import TESTS
from wrt.scene.shapes import icosphere

COLUMNS = {"index": np.arange(5), "t": np.array([0.1, np.inf, np.nan, 1e-45, -16777217.0], np.float32),
           "x": np.array([1 / 3, 1e300, -0.0, 5e-324, 2.0]), "what": np.array(["box", "plane", "box", "none", "cell"])}


def read_csv(path) -> dict[str, list[str]]:
    with open(path, newline="") as file:
        names, *rows = csv.reader(file)
    return dict(zip(names, zip(*rows, strict=True), strict=True))


def test_csv_keeps_bits(tmp_path) -> None:
    write_table(tmp_path / "table.csv", COLUMNS)
    for (name, values), column in zip(read_csv(tmp_path / "table.csv").items(), COLUMNS.values(), strict=True):
        assert np.array(values).astype(column.dtype).tobytes() == column.tobytes(), name


def test_parquet_keeps_bits(tmp_path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet", reason="pyarrow is not installed")
    write_table(tmp_path / "table.parquet", COLUMNS)
    table = parquet.read_table(tmp_path / "table.parquet")
    assert table.column_names == list(COLUMNS)
    for name, column in COLUMNS.items():
        read = np.array(table[name].to_pylist()) if column.dtype.kind == "U" else table[name].to_numpy()
        assert read.dtype == column.dtype and read.tobytes() == column.tobytes(), name


@pytest.mark.parametrize("as_warp", [False, True])
def test_hits_are_one_row_per_ray(tmp_path, as_warp: bool) -> None:
    import warp as wp

    directions = np.random.default_rng(0).normal(size=(3, 5, 3)).astype(np.float32) * (1.0, 1.0, 0.2) - (0.0, 0.0, 1.0)
    origins = np.broadcast_to(np.array([0.0, 0.0, 3.0], np.float32), directions.shape)
    rays = [np.ascontiguousarray(array, np.float32) for array in (origins, directions)]
    hits = wrt.build(icosphere(2)).closest_hit(*(wp.array(ray, dtype=wp.vec3, device="cpu") if as_warp else ray for ray in rays),
                                               counters=True)
    hits.save(tmp_path / "hits.csv")
    rows, flat = read_csv(tmp_path / "hits.csv"), hits.numpy()
    assert 0 < flat.hit.sum() < flat.hit.size
    for name, column in (("t", flat.t), ("u", flat.u), ("prim_id", flat.prim_id), ("y", flat.point[..., 1]),
                         ("nodes", flat.counters.nodes)):
        assert np.array(rows[name]).astype(column.dtype).tobytes() == column.tobytes(), name


def test_a_traces_table_has_its_fetches(tmp_path) -> None:
    trace = wrt.trace(wrt.build(icosphere(2)), [[0.0, 0.0, 3.0]] * 2, [[0.0, 0.0, -1.0], [0.1, 0.0, -1.0]])
    trace.save(tmp_path / "trace.csv")
    rows = read_csv(tmp_path / "trace.csv")
    assert [int(value) for value in rows["address"]] == trace.address.tolist()
    assert [TESTS.index(name) for name in rows["test"]] == trace.test.tolist()
    assert [int(value) for value in rows["ray"]] == trace.ray.tolist()
