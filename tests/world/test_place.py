"""A world as a place of simulated visits: what is compared, what is sent, and where walks go."""

from __future__ import annotations

import shutil
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest

from benchmarks._worlds import small_street
from gsvis.abr import BandwidthTrace
from gsvis.errors import FormatError, GsvisError, SceneError
from gsvis.package import Package
from gsvis.render import rasterize
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.paths import HeadPath
from gsvis.simulate import Link, Place, Stage, Visit, simulate_visits
from gsvis.simulate.frames import Frame, psnr_of
from gsvis.world import World
from gsvis.world.manifest import WORLD
from gsvis.world.place import open_place
from gsvis.world.prepare import prepare_world
from gsvis.world.streamed import WorldSource
from tests.made_once import make_once
from tests.simulate.streets import QUICK
from tests.world.cities import config, write, write_long_city

ALONG = np.array([0.5, -0.5, 0.5, -0.5])  # looks along x, z up
FAST = Link(BandwidthTrace.constant(20.0), 0.02)


@pytest.fixture(scope="module")
def city(shared_folder: Path) -> Path:
    return make_once(shared_folder, "long-city", write_long_city) / "city.gsworld"


@pytest.fixture(scope="module")
def alone(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A world of one tile."""
    folder = tmp_path_factory.mktemp("alone")
    scene = write(small_street(houses=1, step=0.4, flyaways=0), folder / "street.ply")
    prepare_world([scene], folder / "one.gsworld", config(most=5000))
    assert len(World.open(folder / "one.gsworld").manifest.tiles) == 1
    return folder / "one.gsworld"


def walk_between(start: np.ndarray, end: np.ndarray, seconds: float = 4.0) -> HeadPath:
    times = np.linspace(0.0, seconds, 41)
    positions = start + (times / seconds)[:, None] * (end - start)
    return HeadPath(times, positions, np.tile(ALONG, (41, 1)), np.array([0.0, 0.0, 1.0]))


def walk_along(path: Path) -> HeadPath:
    """The longest straight walk between the middles of two cells that stays in cells."""
    grid = open_place(path, walk_between(np.zeros(3), np.ones(3)), as_is=True).scene.index.grid
    pairs = list(combinations(grid.centers, 2))
    for start, end in sorted(pairs, key=lambda pair: -float(np.linalg.norm(pair[1] - pair[0]))):
        walk = walk_between(start, end)
        if (grid.cell_at(walk.positions) >= 0).all():
            return walk
    raise AssertionError("no two cells that touch")


def visit(place: Place, walk: HeadPath) -> Visit:
    return simulate_visits([place], walk, FAST, QUICK)[0]


def test_the_full_scene_is_the_highest_level_of_all_tiles(city: Path) -> None:
    world, walk = World.open(city), walk_along(city)
    place = open_place(city, walk, as_is=True)
    expected = []
    for node in range(len(world.manifest.tiles)):
        with world.package(node) as package:
            contents = package.contents
            expected.append(contents.gaussians(np.flatnonzero(contents.last == len(contents.names) - 1)))
    full = Gaussians.concatenate(expected)
    assert np.array_equal(place.contents.gaussians(np.flatnonzero(place.highest)).means, full.means)
    assert place.highest.sum() == sum(tile.levels[-1][1] for tile in world.manifest.tiles)
    camera = walk.cameras(48, 36, 90.0)[5]
    frame = Frame(Stage(place.contents, members=place.highest), camera)
    assert psnr_of(frame.reference, np.clip(rasterize(full, camera, backend="cpu").images[0], 0.0, 1.0)) > 40.0


def test_districts_are_sent_by_gsvis_alone(city: Path) -> None:
    walk = walk_along(city)
    place = open_place(city, walk)
    package = place.scene.source
    assert isinstance(package, WorldSource)
    assert place.facts["districts"] > 0
    assert place.facts["tiles"] == len(World.open(city).manifest.tiles)
    found = visit(place, walk)
    first = int(package.bases[place.facts["tiles"]])
    ours, whole, morton = (np.isfinite(session.playback.gaussian_at) for session in found.sessions)
    assert ours[first:].any()
    assert np.array_equal(whole, place.highest)
    assert np.array_equal(morton, place.highest)
    assert not place.highest[first:].any()
    assert [session.playback.twice for session in found.sessions] == [0, 0, 0]
    assert "all " in found.compared_with
    assert f"{place.facts['tiles']} tiles of the world" in found.compared_with


def test_a_world_of_one_tile_has_the_figures_of_its_package(alone: Path) -> None:
    """Messages alone differ, by the code of the records: that of a world is found piece by piece."""
    walk, world = walk_along(alone), World.open(alone)
    one = visit(open_place(alone, walk, as_is=True), walk)
    with Package.open(world.package_path(0)) as package:
        other = visit(Place.open(package, as_is=True), walk)
    for mine, theirs in zip(one.sessions[1:], other.sessions[1:], strict=True):
        assert np.array_equal(mine.playback.gaussian_at, theirs.playback.gaussian_at)
        assert np.array_equal(mine.psnr, theirs.psnr)
        assert mine.figures() == theirs.figures()
    ours, theirs = one.sessions[0], other.sessions[0]
    assert np.array_equal(ours.content, theirs.content)
    assert ours.psnr == pytest.approx(theirs.psnr, abs=1.0)
    assert ours.playback.sizes.sum() == pytest.approx(theirs.playback.sizes.sum(), rel=0.03)


def test_a_walk_in_cells_stays_and_another_is_brought_into_them(city: Path) -> None:
    walk = walk_along(city)
    assert open_place(city, walk).space is None
    away = HeadPath(walk.times, walk.positions + 1000.0, walk.quats, walk.up)
    places = [open_place(city, away, seed=seed) for seed in (0, 1)]
    for place in places:
        found = visit(place, away)
        assert place.space is not None
        assert found.path["rule"] != "left as it is"
        voxels = place.space.origin + place.space.voxel_size * (np.argwhere(place.space.free) + 0.5)
        assert len(voxels)
        assert (place.scene.index.grid.cell_at(voxels) >= 0).all()
    assert len({place.space.origin.tobytes() for place in places if place.space is not None}) > 1


@pytest.fixture
def copy(city: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(city, tmp_path / "copy.gsworld"))


@pytest.mark.parametrize("kind", ["missing", "damaged"])
def test_a_damaged_tile_is_refused(copy: Path, kind: str, caplog: pytest.LogCaptureFixture) -> None:
    """A server leaves it out; a figure against the rest of the world would be wrong."""
    folder = World.open(copy).package_path(1)
    if kind == "missing":
        shutil.rmtree(folder)
    else:
        part = max(folder.glob("parts/*.bin"), key=lambda path: path.stat().st_size)
        part.write_bytes(part.read_bytes()[:-1] + b"?")
    with pytest.raises(GsvisError, match=r"node 1|" + folder.name):
        open_place(copy, walk_between(np.zeros(3), np.ones(3)))
    assert not caplog.records


def test_a_world_without_cells_is_refused(copy: Path) -> None:
    world = World.open(copy)
    outside = next(tile for tile in world.manifest.tiles if not tile.cells)
    replace(world.manifest, tiles=(outside,), districts=()).write(copy / WORLD)
    with pytest.raises(SceneError, match="no tile has cells"):
        open_place(copy, walk_between(np.zeros(3), np.ones(3)))


def test_a_folder_that_is_no_world_is_refused(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match="a folder with neither"):
        open_place(tmp_path, walk_between(np.zeros(3), np.ones(3)))
