"""Facts for a viewer: they agree with the store of visible sets, and nothing that a client asks breaks the server."""

from __future__ import annotations

import base64
import json
import zlib
from pathlib import Path

import numpy as np
import pytest

from gsvis.package import Package
from gsvis.pvs.cells import CellGrid
from gsvis.pvs.floor import _lowest_runs, level_axes
from gsvis.pvs.walk import find_walk
from gsvis.raycast.directions import face_of
from gsvis.serve.facts import describe_floor
from gsvis.stream import StreamedScene
from tests.serve.servers import ask, serving


def test_why_agrees_with_the_store(celled: Path) -> None:
    with serving(celled) as server, Package.open(celled) as package:
        sets, means = package.visibility, package.contents.gaussians().means
        for gaussian in (0, 7, len(package) - 1):
            status, fields, body = ask(server, f"/scenes/celled/why/{gaussian}")
            assert (status, fields["content-type"]) == (200, "application/json")
            found = json.loads(body)
            rows = found["cells"]["seeing"]
            seers = [cell for cell in range(len(sets)) if sets.class_of(gaussian, cell) >= 0]
            assert sorted(row["cell"] for row in rows) == seers == sets.seers(gaussian).tolist()
            assert [row["distance"] for row in rows] == sorted(row["distance"] for row in rows)
            for row in rows:
                away = sets.grid.centers[row["cell"]] - means[gaussian]
                np.testing.assert_allclose(np.array(row["direction"]) * row["distance"], away, atol=1e-3)
                low, high = sets.class_interval(sets.class_of(gaussian, row["cell"]))
                np.testing.assert_allclose(row["weight"], [low, min(high, 1.0)], atol=1e-6)
            faces = np.zeros(80, np.uint8)
            if found["directions"]["seen"]:
                faces[face_of(found["directions"]["seen"])] = 1
            assert np.packbits(faces, bitorder="little").tolist() == sets.direction_sets[gaussian].tolist()
            assert found["terms"] == package.contents.term_counts[gaussian]
            np.testing.assert_allclose(found["mean"], means[gaussian], atol=1e-4)
        cells = json.loads(ask(server, "/scenes/celled/cells")[2])
        assert np.array_equal(cells["boxes"], sets.grid.coords)
        assert cells["visible"] == sets.visible_counts.tolist()


def test_marks_agree_with_the_store(celled: Path) -> None:
    with serving(celled) as server, Package.open(celled) as package:
        sets = package.visibility
        found = json.loads(ask(server, "/scenes/celled/seen")[2])
        cells, weights = (np.frombuffer(base64.b64decode(found[key]), np.uint8) for key in ("cells", "weights"))
        assert len(cells) == len(weights) == len(package)
        for gaussian in range(0, len(package), 97):
            seers = sets.seers(gaussian)
            assert cells[gaussian] == int(np.ceil(255 * len(seers) / len(sets)))
            classes = [sets.class_of(gaussian, cell) for cell in seers.tolist()]
            assert weights[gaussian] == round(255 * (max(classes, default=-1) + 1) / len(found["classes"]))
        assert found["classes"] == pytest.approx(sets.info.class_edges.tolist(), abs=1e-8)


@pytest.mark.parametrize("given", ["1500", "99999999999999999999", "-1", "1.5", "x", "9" * 5000, ""])
def test_what_is_no_gaussian_has_no_reason(celled: Path, given: str) -> None:
    with serving(celled) as server:
        assert ask(server, f"/scenes/celled/why/{given}")[0] == 404


def test_a_package_without_sets_says_what_it_can(plain: Path) -> None:
    with serving(plain, token="s3cret") as server:
        assert ask(server, "/scenes/plain/why/3")[0] == 401
        shown = {"Authorization": "Bearer s3cret"}
        found = json.loads(ask(server, "/scenes/plain/why/3", **shown)[2])
        assert (found["gaussian"], found["cells"], found["directions"]) == (3, None, None)
        for fact in ("floor", "seen", "walk"):
            assert json.loads(ask(server, f"/scenes/plain/{fact}", **shown)[2]) is None
        for path in ("/scenes/none/why/3", "/scenes/plain/scene.json", "/scenes/plain/records.bin", "/scenes/plain/x"):
            assert ask(server, path, **shown)[0] == 404


def test_a_damaged_store_is_said(celled: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from gsvis.errors import FormatError

    def broken(*_: object) -> None:
        raise FormatError("sets", "cell 3", "a set", "another")

    monkeypatch.setattr("gsvis.serve._questions.explain", broken)
    with serving(celled) as server:
        assert ask(server, "/scenes/celled/why/3")[0] == 500
        assert server.metrics.scenes.faults.value("celled") == 1


def test_a_walker_stands_in_the_cells_of_a_package(celled: Path) -> None:
    with serving(celled) as server, Package.open(celled) as package:
        packed = base64.b64decode(json.loads(ask(server, "/scenes/celled/walk")[2])["packed"])
        said = json.loads(zlib.decompress(packed).partition(b"\n")[0])
        meters = package.manifest.info.meters_per_unit
        walk = find_walk(package.contents.gaussians(), package.visibility.grid, meters)
        assert walk is not None
        assert said["shape"] == list(walk.open.shape)
        assert np.allclose(said["axes"][2], package.visibility.grid.up)


def test_a_floor_lies_where_cells_are(celled: Path) -> None:
    with Package.open(celled) as package:
        scene = StreamedScene.open(package)
        floor = describe_floor(scene)
        assert floor is not None
        grid, up = scene.index.grid, np.array(floor["up"])
        heights = np.array([np.nan if height is None else height for height in floor["heights"]])
        assert len(heights) == floor["columns"] * floor["rows"]
        assert np.isfinite(heights).any()
        for k in np.flatnonzero(np.isfinite(heights)):
            row, column = divmod(int(k), floor["columns"])
            at = np.array(floor["origin"]) + up * heights[k]
            at = at + floor["side"] * (
                (column + 0.5) * np.array(floor["first"]) + (row + 0.5) * np.array(floor["second"])
            )
            assert grid.cell_at(at[None])[0] >= 0, "an eye stands outside all cells"
        columns = {tuple(np.delete(box, int(np.abs(up).argmax()))) for box in grid.coords.tolist()}
        assert np.isfinite(heights).sum() == len(columns)


def test_the_lowest_run_of_cells_is_found() -> None:
    free = np.array([[0, 1, 1, 0, 1], [0, 0, 0, 0, 0], [1, 1, 1, 1, 1]], bool)
    levels = np.arange(5) + 0.5
    bottom, top = _lowest_runs(free, levels, 1.0)
    np.testing.assert_array_equal(bottom, [1.0, np.nan, 0.0])
    np.testing.assert_array_equal(top, [3.0, np.nan, 5.0])


@pytest.mark.parametrize("up", [(0, 0, 1), (0, -1, 0), (0.6, 0.0, 0.8), (1, 1, 1)])
def test_level_axes_are_across(up: tuple[float, float, float]) -> None:
    axis = np.array(up, float) / np.linalg.norm(up)
    frame = np.stack([*level_axes(axis), axis])
    np.testing.assert_allclose(frame @ frame.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(frame) == pytest.approx(1.0)


def test_a_point_outside_the_grid_is_in_no_cell() -> None:
    grid = CellGrid(np.zeros(3), 1.0, (2, 1, 1), np.array([[1, 0, 0]], np.int32), np.array([0.0, 0.0, 1.0]))
    points = np.array([[0.5, 0.5, 0.5], [1.5, 0.5, 0.5], [2.5, 0.5, 0.5], [-1e9, 0, 0]])
    assert (grid.cell_at(points) >= 0).tolist() == [False, True, False, False]
