"""3D Tiles as written: the laws of the format, the scene in the tiles, upright, and volumes that hold their cells."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gsvis.errors import SceneError
from gsvis.export import TilesOptions, write_glb, write_tiles
from gsvis.export.leaves import cut_leaves
from gsvis.export.needs import find_needs
from gsvis.export.tileset import find_volumes, level_errors
from gsvis.io import load_scene
from gsvis.package import Package, write_package
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.levels import Levels
from gsvis.scene.procedural import random_scene
from tests.export.test_needs import store_of
from tests.package.worlds import colors_of, levels_of, sets_of

PLAIN = TilesOptions(leaf=64, compression="none")
TO_TILES = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # glTF's +y up to the +z up of tiles


def document_of(folder: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((folder / "tileset.json").read_bytes())
    return found


def tiles_of(tile: dict[str, Any]) -> Iterator[dict[str, Any]]:
    yield tile
    for child in tile.get("children", []):
        yield from tiles_of(child)


def holds(box: list[float], points: np.ndarray, slack: float = 1e-4) -> bool:
    """Whether points lie in a box of 12 numbers, whose sides are at right angles."""
    middle, axes = np.array(box[:3]), np.array(box[3:]).reshape(3, 3)
    lengths = np.linalg.norm(axes, axis=1)
    assert np.abs(axes @ axes.T - np.diag(lengths**2)).max() < 1e-5 * lengths.max() ** 2
    return bool((np.abs((points - middle) @ (axes / lengths[:, None]).T) <= lengths + slack).all())


def corners(box: list[float]) -> np.ndarray:
    middle, axes = np.array(box[:3]), np.array(box[3:]).reshape(3, 3)
    return middle + np.array([[a, b, c] for a in (-1, 1) for b in (-1, 1) for c in (-1, 1)]) @ axes


def check_laws(folder: Path) -> None:
    """What 3D Tiles 1.1 asks of any tileset, and that every file is named once and no other lies there."""
    document = document_of(folder)
    assert document["asset"]["version"] == "1.1"
    assert document["root"]["refine"] == "REPLACE"
    assert document["geometricError"] >= 0
    named = []
    for tile in tiles_of(document["root"]):
        assert set(tile) <= {
            "boundingVolume", "geometricError", "content", "children", "refine", "transform", "viewerRequestVolume",
        }  # fmt: skip
        assert tile["geometricError"] >= 0
        assert tile.get("children") != []
        assert "content" in tile or "children" in tile
        for child in tile.get("children", []):
            assert child["geometricError"] <= tile["geometricError"]
            assert holds(tile["boundingVolume"]["box"], corners(child["boundingVolume"]["box"]))
        if "content" in tile:
            named.append(tile["content"]["uri"])
            means = load_scene(folder / named[-1]).means @ TO_TILES.T
            assert holds(tile["boundingVolume"]["box"], means)
        if "children" not in tile:
            assert tile["geometricError"] == 0
    assert sorted(named) == sorted(path.name for path in folder.glob("*.glb"))
    assert len(set(named)) == len(named)


def finest(folder: Path) -> Gaussians:
    """The Gaussians of all tiles without children, in the frame of glTF."""
    root = document_of(folder)["root"]
    return Gaussians.concatenate(
        [load_scene(folder / tile["content"]["uri"]) for tile in tiles_of(root) if "children" not in tile]
    )


def by_place(g: Gaussians) -> Gaussians:
    return g[np.lexsort(g.means.T)]


@pytest.mark.parametrize("up", [(0.0, 0.0, 1.0), (0.0, -1.0, 0.0), (0.6, 0.0, 0.8)])
def test_the_tiles_hold_the_scene_upright(tmp_path: Path, up: tuple[float, float, float]) -> None:
    g = random_scene(np.random.default_rng(1), 500, sh_degree=2)
    found = write_tiles(tmp_path / "t", g, TilesOptions(leaf=64, compression="none", up=up))
    check_laws(tmp_path / "t")
    again = finest(tmp_path / "t")
    assert (len(again), found.counts, found.leaves, found.tiles) == (500, (500,), 8, 8)
    heights = np.sort(again.means[:, 1])  # glTF points up along y
    np.testing.assert_allclose(heights, np.sort(g.means @ np.array(up)), atol=1e-5)
    assert found.nbytes == sum(file.stat().st_size for file in (tmp_path / "t").iterdir())
    if up == (0.0, -1.0, 0.0):
        first, second = by_place(g.transform(np.diag([1.0, -1.0, -1.0]))), by_place(again)
        for name in ("means", "scales", "opacities", "sh0", "shN"):
            np.testing.assert_array_equal(getattr(second, name), getattr(first, name))


def test_levels_are_chains_that_end_with_the_finest(tmp_path: Path) -> None:
    levels = levels_of(400)
    found = write_tiles(tmp_path / "t", levels, PLAIN)
    check_laws(tmp_path / "t")
    assert len(finest(tmp_path / "t")) == levels.counts[2]
    chains = [tile for tile in tiles_of(document_of(tmp_path / "t")["root"]) if "content" in tile]
    for tile in chains:
        assert len(tile.get("children", [])) <= 1
    assert found.tiles == len(chains) > found.leaves


def test_the_error_of_a_level_is_how_far_its_gaussians_are() -> None:
    """Ten on a line; the low level has every other one: five are 0 away and five 1."""
    means = np.column_stack([np.arange(10.0), np.zeros(10), np.zeros(10)])
    g = random_scene(np.random.default_rng(0), 10)
    g = Gaussians(means, g.quats, g.scales, g.opacities, g.sh0, g.shN)
    levels = Levels(g, np.arange(10) % 2, np.ones(10, int), ("low", "high"))
    errors = level_errors(cut_leaves(levels, most=64))
    np.testing.assert_allclose(errors, [[0.0], [16.0 * np.sqrt(0.5)]])


def test_the_same_level_twice_is_one_tile(tmp_path: Path) -> None:
    g = random_scene(np.random.default_rng(0), 100)
    found = write_tiles(tmp_path / "t", Levels(g, np.zeros(100, int), np.ones(100, int), ("low", "high")), PLAIN)
    assert (found.tiles, found.leaves) == (2, 2)
    check_laws(tmp_path / "t")


def test_meters_are_the_scale_of_the_root(tmp_path: Path) -> None:
    g = random_scene(np.random.default_rng(0), 100)
    write_tiles(tmp_path / "t", g, TilesOptions(leaf=64, meters_per_unit=2.5))
    document = document_of(tmp_path / "t")
    assert document["root"]["transform"] == [2.5, 0, 0, 0, 0, 2.5, 0, 0, 0, 0, 2.5, 0, 0, 0, 0, 1]
    assert document["geometricError"] == pytest.approx(2.5 * document["root"]["geometricError"], rel=1e-5)
    found = write_glb(tmp_path / "a.glb", g, TilesOptions(compression="none", meters_per_unit=2.5, up=(0, 1, 0)))
    np.testing.assert_allclose(load_scene(tmp_path / "a.glb").scales, 2.5 * g.scales, rtol=1e-6)
    assert found.nbytes == (tmp_path / "a.glb").stat().st_size


def test_far_gaussians_are_a_tile_of_their_own(tmp_path: Path) -> None:
    g = random_scene(np.random.default_rng(0), 500)
    means = g.means.copy()
    means[7] = (900.0, 0, 0)
    found = write_tiles(tmp_path / "t", Gaussians(means, g.quats, g.scales, g.opacities, g.sh0, g.shN), PLAIN)
    check_laws(tmp_path / "t")
    assert (found.environment, len(finest(tmp_path / "t"))) == (1, 500)
    document = document_of(tmp_path / "t")
    assert len(document["root"]["children"]) == 2
    assert document["geometricError"] < 300  # not of the box of what flies around


def test_compressed_tiles_say_so_where_cesium_looks(tmp_path: Path) -> None:
    write_tiles(tmp_path / "t", random_scene(np.random.default_rng(0), 100), TilesOptions(leaf=64))
    document = document_of(tmp_path / "t")
    both = ["KHR_gaussian_splatting", "KHR_gaussian_splatting_compression_spz_2"]
    assert document["extensionsUsed"] == ["3DTILES_content_gltf"]
    assert document["extensions"]["3DTILES_content_gltf"] == {"extensionsUsed": both, "extensionsRequired": both}
    check_laws(tmp_path / "t")


def test_a_volume_holds_every_cell_that_needs_its_leaf(tmp_path: Path) -> None:
    g, heap = random_scene(np.random.default_rng(0), 200), np.arange(200) // 50
    means = 0.2 * g.means + 20.0 * heap[:, None] * np.eye(3)[0]
    g = Gaussians(means, g.quats, g.scales, g.opacities, g.sh0, g.shN)
    left, right = (np.flatnonzero(heap == k) for k in (0, 1))
    with store_of(tmp_path / "s.pvs", g, [left, np.concatenate([left, right]), right], (3, 1, 1)) as store:
        options = TilesOptions(leaf=64, compression="none", request_volumes=True, up=(0, 0, 1))
        found = write_tiles(tmp_path / "t", g, options, visibility=store)
        leaves = cut_leaves(Levels.single(g), most=64)
        needs = find_needs(leaves, store)
        volumes = find_volumes(needs)
        grid = store.grid
    check_laws(tmp_path / "t")
    for leaf in range(len(leaves)):
        cells = grid.origin + grid.cell_size * needs.boxes[needs.needed[:, leaf]]
        assert volumes.needed[leaf] == bool(len(cells))
        if len(cells):
            assert (volumes.boxes[leaf, 0] <= cells + 1e-9).all()
            assert (volumes.boxes[leaf, 1] >= cells + grid.cell_size - 1e-9).all()
            assert volumes.inside[needs.needed[:, leaf], leaf].all()
    tiles = [tile for tile in tiles_of(document_of(tmp_path / "t")["root"]) if "content" in tile]
    assert len(tiles) == found.leaves == int(volumes.needed.sum())
    assert sum("viewerRequestVolume" in tile for tile in tiles) == found.volumes == int(volumes.bounded.sum()) > 0
    assert (found.unneeded, len(leaves)) == (2, 4)  # nobody sees two of the heaps
    assert found.needed <= found.requested < 1.0
    boxes = [tile["viewerRequestVolume"]["box"] for tile in tiles if "viewerRequestVolume" in tile]
    wanted = volumes.boxes[volumes.bounded].mean(axis=1)  # +z is up already
    np.testing.assert_allclose(sorted(box[:3] for box in boxes), sorted(wanted.tolist()), atol=1e-5)


def test_a_package_without_visible_sets_is_refused_at_once(tmp_path: Path) -> None:
    levels = levels_of(300)
    write_package(tmp_path / "p.gsvis", levels, colors_of(len(levels.union))[1]).close()
    options = TilesOptions(leaf=64, request_volumes=True)
    with (
        Package.open(tmp_path / "p.gsvis") as package,
        pytest.raises(ValueError, match="request_volumes: expected visible"),
    ):
        write_tiles(tmp_path / "t", package, options)
    assert not (tmp_path / "t").exists()


def test_a_package_brings_its_visible_sets_and_up(tmp_path: Path) -> None:
    levels = levels_of(300)
    _, quantized = colors_of(len(levels.union))
    write_package(tmp_path / "p.gsvis", levels, quantized, visibility=sets_of(tmp_path, levels)).close()
    with Package.open(tmp_path / "p.gsvis") as package:
        found = write_tiles(tmp_path / "t", package, TilesOptions(leaf=64, request_volumes=True))
        assert found.cells == len(package.visibility) > 1
    check_laws(tmp_path / "t")
    assert 0.0 < found.needed <= found.requested <= 1.0


def test_the_same_scene_gives_the_same_bytes_and_replaces_the_last(tmp_path: Path) -> None:
    g = random_scene(np.random.default_rng(0), 300)
    write_tiles(tmp_path / "t", random_scene(np.random.default_rng(5), 300), PLAIN)
    (tmp_path / "t" / ".mine").write_text("kept")
    with pytest.raises(ValueError, match="--overwrite"):
        write_tiles(tmp_path / "t", g, PLAIN)
    write_tiles(tmp_path / "t", g, PLAIN, overwrite=True)
    write_tiles(tmp_path / "u", g, PLAIN)
    assert (tmp_path / "t" / ".mine").read_text() == "kept"
    first = {p.name: p.read_bytes() for p in (tmp_path / "t").iterdir() if p.name != ".mine"}
    assert first == {p.name: p.read_bytes() for p in (tmp_path / "u").iterdir()}
    check_laws(tmp_path / "t")


def test_a_folder_of_something_else_stays(tmp_path: Path) -> None:
    (tmp_path / "t").mkdir()
    (tmp_path / "t" / "tileset.json").write_text('{"asset": {"version": "1.1", "generator": "other"}}')
    with pytest.raises(ValueError, match="of something else"):
        write_tiles(tmp_path / "t", random_scene(np.random.default_rng(0), 100), PLAIN, overwrite=True)
    assert [p.name for p in (tmp_path / "t").iterdir()] == ["tileset.json"]


def test_an_empty_scene_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SceneError, match="at least one Gaussian"):
        write_tiles(tmp_path / "t", Gaussians.empty(), PLAIN)
    with pytest.raises(SceneError, match="at least one Gaussian"):
        write_glb(tmp_path / "a.glb", Gaussians.empty())
    assert not list(tmp_path.iterdir())
