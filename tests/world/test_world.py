"""A small city from end to end: the same bytes whatever happens on the way, ids across borders, and what is refused."""

from __future__ import annotations

import json
import os
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gsvis.cli import main
from gsvis.errors import FormatError, SceneError
from gsvis.jobs import graph
from gsvis.jobs.workers import Workers
from gsvis.package import Package
from gsvis.pvs.fill import read_overdraw, sample_fill_of_cells
from gsvis.train.levels import LevelsConfig
from gsvis.world import Tile, World, packages
from gsvis.world.prepare import check_world_target, prepare_world
from tests.made_once import make_once
from tests.world import cities

Scene = tuple[str, None]


@pytest.fixture(scope="module")
def city(shared_folder: Path) -> Path:
    return make_once(shared_folder, "city", cities.write_city) / "city.gsworld"


@pytest.fixture(scope="module")
def scene(city: Path) -> Scene:
    return str(city.with_name("street.ply")), None


@pytest.fixture
def copy(city: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(city, tmp_path / "copy.gsworld"))


def test_a_world_is_whole_and_its_tiles_hold_every_gaussian_once(city: Path) -> None:
    world = World.open(city)
    found = world.verify()
    g = cities.street()
    assert found.gaussians == len(g)
    assert found.tiles >= 4
    assert found.strays == 0
    means = []
    for tile in range(found.tiles):
        with world.package(tile) as package:
            means.append(package.contents.gaussians().means)
    together = np.concatenate(means)
    apart = np.abs(np.sort(together[:, 0]) - np.sort(g.means[:, 0]))
    assert np.quantile(apart, 0.99) < 0.01  # but for what rounding moves, the same Gaussians
    outside = world.manifest.tiles[-1]
    assert outside.coords is None
    assert outside.gaussians >= 12


def test_every_tile_is_a_package_of_today(city: Path) -> None:
    world = World.open(city)
    for node in range(len(world)):
        with Package.open(world.package_path(node)) as package:
            package.verify()


def test_tiles_state_the_overdraw_of_all_that_their_cells_see(city: Path) -> None:
    """What lies around a tile counts too: no cell has fewer splats than of its own tile, and some have more."""
    world, more = World.open(city), 0
    for tile, entry in enumerate(world.manifest.tiles):
        if not entry.cells:
            continue
        with world.package(tile) as package:
            stated = read_overdraw(package.manifest.info.provenance["overdraw"], entry.cells)
            alone = sample_fill_of_cells(package.contents.levels(), package.visibility)
        assert stated is not None
        assert (stated.splats >= 0.95 * alone.splats).all()  # records are rounded
        more += int(np.count_nonzero(stated.splats > 1.1 * alone.splats))
    assert more


def test_inspect_prints_the_overdraw_of_all_cells_of_all_tiles(city: Path, capsys: pytest.CaptureFixture[str]) -> None:
    world = World.open(city)
    worst = []
    for tile, entry in enumerate(world.manifest.tiles):
        with world.package(tile) as package:
            stated = package.manifest.info.provenance.get("overdraw")
        if stated is not None:
            assert len(stated["worst"]) == entry.cells
            worst += stated["worst"]
    assert main(["inspect", str(city), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["cells"] == len(found["cell_overdraw"]["cells"]) == len(worst)
    assert found["cell_overdraw"]["largest"]["worst"] == max(worst)
    assert main(["inspect", str(city)]) == 0
    assert f"{max(worst):,} at most" in capsys.readouterr().out
    assert main(["inspect", str(city), "--histograms"]) == 2
    assert "--histograms: expected none for a world" in capsys.readouterr().err


def test_cells_see_across_the_border(city: Path) -> None:
    world = World.open(city)
    tiles = len(world.manifest.tiles)
    crossing = 0
    for tile in range(tiles):
        beyond = world.beyond(tile)
        entry = world.manifest.tiles[tile]
        assert (beyond is None) == (entry.cells == 0)
        if beyond is None:
            continue
        assert len(beyond) == entry.cells
        for cell in range(len(beyond)):
            for seen in beyond.of_cell(cell):
                node = world.manifest.node(seen.node)
                assert seen.node != tile
                assert len(seen.ids) == len(seen.classes) > 0
                assert (np.diff(seen.ids) > 0).all()
                assert seen.ids[-1] < node.gaussians
                crossing += isinstance(node, Tile)
        beyond.close()
    assert crossing


def test_ids_beyond_a_tile_are_those_that_its_pieces_count(city: Path) -> None:
    """What is found by runs is what a list of all ids of the pieces says."""
    world, found = World.open(city), 0
    for tile in range(len(world.manifest.tiles)):
        beyond = world.beyond(tile)
        if beyond is None:
            continue
        nodes = np.repeat([piece.node for piece in beyond.table.pieces], [piece.count for piece in beyond.table.pieces])
        every = np.concatenate([piece.ids() for piece in beyond.table.pieces])
        for cell in range(len(beyond)):
            ids = beyond.store.visible_ids(cell)
            seen = beyond.of_cell(cell)
            assert np.concatenate([each.ids for each in seen]).tolist() == every[ids].tolist()
            assert (
                np.repeat([each.node for each in seen], [len(each.ids) for each in seen]).tolist()
                == nodes[ids].tolist()
            )
            assert [(each.node, each.ids.tolist()) for each in seen] == [
                (node, some.tolist()) for node, some in beyond.ids_of_cell(cell)
            ]
            found += len(ids)
        beyond.close()
    assert found


def test_what_is_seen_beyond_is_what_a_look_at_the_whole_street_sees(city: Path) -> None:
    """An eye in a cell, looking at the whole street: most of its weight is in the sets of the cell, by (node, id)."""
    from gsvis.pvs.look import Look

    world = World.open(city)
    whole = cities.street()
    look = Look(whole, "raster", 48, 1.0 / 255.0)
    shares = []
    for tile, entry in enumerate(world.manifest.tiles):
        beyond = world.beyond(tile)
        if beyond is None or not entry.cells:
            continue
        with world.package(tile) as package:
            store = package.visibility
            eye = store.grid.centers[0]
            ids, weights = look(eye)
            places = [package.contents.gaussians(store.visible_ids(0)).means]
            for seen in beyond.of_cell(0):
                with world.package(seen.node) as other:
                    places.append(other.contents.gaussians(seen.ids).means)
        held = np.concatenate(places)
        apart = np.linalg.norm(whole.means[ids][:, None] - held[None], axis=2).min(axis=1)
        near = np.linalg.norm(whole.means[ids] - eye, axis=1) < 8.0  # farther off, districts stand in
        shares.append(float(weights[near & (apart < 0.05)].sum() / max(weights[near].sum(), 1e-9)))
        beyond.close()
    assert len(shares) >= 3
    assert np.median(shares) > 0.9


@pytest.mark.usefixtures("warm_processes")
def test_workers_and_the_order_of_scenes_change_no_byte(scene: Scene, city: Path, tmp_path: Path) -> None:
    g = cities.street()
    order = np.random.default_rng(3).permutation(len(g))
    cut = len(g) // 3
    scenes = [cities.write(g[order[:cut]], tmp_path / "b.ply"), cities.write(g[order[cut:]], tmp_path / "a.ply")]
    again = tmp_path / "again.gsworld"
    prepare_world(scenes, again, cities.config(), workers=Workers(2))
    assert cities.content(again) == cities.content(city)


@pytest.mark.parametrize(("stage", "after"), [("splitting", 3), ("levels", 9), ("tiles", 14), ("world", 2)])
def test_a_stopped_run_goes_on_to_the_same_bytes(
    scene: Scene, city: Path, tmp_path: Path, stage: str, after: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, ran = tmp_path / "city.gsworld", list[str]()
    perform = graph.perform
    monkeypatch.setattr(graph, "perform", lambda job: (ran.append(job.task.name), perform(job))[1])

    def stop(name: str, done: int, total: int) -> None:
        if name == stage and done >= after:
            raise KeyboardInterrupt

    shutil.copytree(city.with_name("city.gsworld.work"), path.with_name("city.gsworld.work"))
    for note in sorted((path.with_name("city.gsworld.work") / "notes").iterdir())[::3]:  # a third was not finished
        note.unlink()
    with pytest.raises(KeyboardInterrupt):
        prepare_world([scene], path, cities.config(), progress=stop)
    assert not (path / "world.json").exists()
    before = len(ran)
    prepare_world([scene], path, cities.config())
    assert len(set(ran)) == len(ran), "nothing is done twice"
    assert len(ran) - before < 60
    assert cities.content(path) == cities.content(city)


def test_a_scene_that_is_replaced_in_its_size_and_time_is_read_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The sample of a batch is found again only where the bytes of the scene are the same."""
    path, ran = Path(cities.write(cities.street(), tmp_path / "s.ply")[0]), list[str]()
    perform = graph.perform
    monkeypatch.setattr(graph, "perform", lambda job: (ran.append(job.task.name), perform(job))[1])

    def stop(name: str, done: int, total: int) -> None:
        if name == "sampling" and done == total:
            raise KeyboardInterrupt

    counts = []
    for _ in range(3):
        with pytest.raises(KeyboardInterrupt):
            prepare_world([(str(path), None)], tmp_path / "city.gsworld", cities.config(), progress=stop)
        counts.append(len([name for name in ran if name.startswith("sample")]))
        if len(counts) == 2:
            data, state = bytearray(path.read_bytes()), path.stat()
            data[-3] ^= 1
            path.write_bytes(data)
            os.utime(path, ns=(state.st_atime_ns, state.st_mtime_ns))
    assert counts[0] == counts[1] > 0
    assert counts[2] == 2 * counts[0]


def test_eyes_of_a_world_are_along_its_walk(scene: Scene, city: Path, tmp_path: Path) -> None:
    walk = ((0.5, 2.0, 1.5), (3.0, 2.0, 1.5))
    path = tmp_path / "city.gsworld"
    prepare_world([scene], path, replace(cities.config(), walk=walk, margin=0.8))
    world, everywhere = World.open(path), World.open(city)
    assert sum(tile.cells > 0 for tile in world.manifest.tiles) > 0
    for k, (tile, free) in enumerate(zip(world.manifest.tiles, everywhere.manifest.tiles, strict=True)):
        assert (tile.coords, tile.shape) == (free.coords, free.shape), "tiles do not depend on the walk"
        assert tile.levels[-1][1] == free.levels[-1][1]
        if tile.cells:
            with world.package(k) as package:
                grid = package.visibility.grid
            on_walk = np.clip(grid.centers, *np.array(walk))
            apart = np.linalg.norm(grid.centers - on_walk, axis=1)
            assert apart.max() <= 0.8 + np.sqrt(3.0) * grid.cell_size
    far = [k for k, tile in enumerate(world.manifest.tiles) if tile.low[0] > 3.8]
    assert far
    assert not any(world.manifest.tiles[k].cells for k in far)


def test_a_walk_in_another_frame_is_refused_before_levels_are_made(scene: Scene, tmp_path: Path) -> None:
    config = replace(cities.config(), walk=((900.0, 900.0, 900.0),), margin=0.5)
    with pytest.raises(SceneError, match=r"the walk comes near no tile; bring it into the frame of the scenes"):
        prepare_world([scene], tmp_path / "city.gsworld", config)


def test_a_walk_that_is_none_is_refused() -> None:
    for margin in (0.0, -1.0, np.inf, np.nan):
        with pytest.raises(ValueError, match="margin"):
            replace(cities.config(), margin=margin)
    for walk in ((), ((0.0, 1.0),), ((0.0, 1.0, np.nan),)):
        with pytest.raises(ValueError, match="walk"):
            replace(cities.config(), walk=walk)  # type: ignore[arg-type]


def test_levels_are_trained_for_tiles(scene: Scene, tmp_path: Path) -> None:
    path = tmp_path / "city.gsworld"
    levels = LevelsConfig((0.3,), (0.9,), ("low", "high"), iterations=3, preview=0.1, preview_from=0)  # none in tiles
    prepare_world([scene], path, cities.config(levels, most=4000))
    world = World.open(path)
    world.verify()
    assert [name for name, _ in world.manifest.tiles[0].levels] == ["low", "high"]


def test_a_package_alone_is_a_world_of_one_tile(city: Path) -> None:
    whole = World.open(city)
    alone = World.open(whole.package_path(0))
    assert alone.alone
    assert len(alone) == 1
    assert alone.tile_at([1e6, 0.0, 0.0]) == 0
    assert alone.beyond(0) is None
    assert alone.manifest.tiles[0].cells == whole.manifest.tiles[0].cells
    with alone.package(0) as package:
        assert len(package) == whole.manifest.tiles[0].gaussians
    assert alone.verify().gaussians == whole.manifest.tiles[0].gaussians


def test_positions_are_found_in_their_tiles(city: Path) -> None:
    world = World.open(city)
    for number, tile in enumerate(world.manifest.tiles):
        if tile.coords is not None:
            assert world.tile_at(0.5 * (np.array(tile.low) + np.array(tile.high))) == number
    assert world.tile_at([1e5, 0.0, 0.0]) == -1


def test_a_missing_or_damaged_part_is_named(copy: Path) -> None:
    world = World.open(copy)
    folder = world.package_path(1)
    part = next(iter((folder / "parts").iterdir()))
    data = part.read_bytes()
    part.write_bytes(data[:-1] + bytes([data[-1] ^ 1]))
    with pytest.raises(FormatError, match="content that fits its name"):
        world.verify()
    manifest = folder / "manifest.json"
    text = manifest.read_text()
    manifest.write_text(text.replace('"version": 3', '"version": 9'))
    with pytest.raises(FormatError, match="the name of the folder"):
        world.package(1)
    shutil.rmtree(folder)
    with pytest.raises(FormatError, match=r"node 1: expected a package in .*, got no such package; prepare"):
        world.package(1)


def test_a_missing_or_damaged_table_is_named(copy: Path) -> None:
    world = World.open(copy)
    tile = next(k for k, each in enumerate(world.manifest.tiles) if each.beyond is not None)
    table = next((copy / "beyond").iterdir())
    table.write_bytes(table.read_bytes()[:-1])
    with pytest.raises(FormatError, match=r"\.pvs"):
        world.verify()
    shutil.rmtree(copy / "beyond")
    with pytest.raises(FormatError, match="a table of the world, got no such file; prepare the world again"):
        world.beyond(tile)


def test_strays_are_counted_and_removed_by_the_next_run(scene: Scene, city: Path, copy: Path) -> None:
    (copy / "packages" / ("0" * 64)).mkdir()
    assert World.open(copy).verify().strays == 1
    shutil.copytree(city.with_name("city.gsworld.work"), copy.with_name("copy.gsworld.work"))
    prepare_world([scene], copy, cities.config())
    assert cities.content(copy) == cities.content(city)


def test_surroundings_that_do_not_fit_the_memory_are_refused(
    scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(packages.MEMORY, "prepare_tile", lambda params, inputs: 0)  # the task itself refuses
    monkeypatch.setattr(packages, "tile_memory", lambda own, counts, joint, *_: 10**9 if joint > own else 0)
    with pytest.raises(
        ValueError, match=r"max_memory: expected at least .* GB for a worker .* tile \d+-\d+, got 0.48 GB; raise it"
    ):
        prepare_world([scene], tmp_path / "city.gsworld", cities.config(), workers=Workers(1, max_memory=480_000_000))


def test_a_stage_that_does_not_fit_the_memory_is_refused_before_it_starts(scene: Scene, tmp_path: Path) -> None:
    with pytest.raises(
        ValueError, match=r"max_memory: expected at least 0.4\d* GB .* one of them with space 0, got 0.35 GB; raise it"
    ):
        prepare_world([scene], tmp_path / "city.gsworld", cities.config(), workers=Workers(1, max_memory=350_000_000))


def test_something_else_is_not_replaced(tmp_path: Path) -> None:
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "cat.jpg").write_bytes(b"cat")
    with pytest.raises(FormatError, match=r"a world or an empty folder, got 'cat.jpg'"):
        check_world_target(tmp_path / "photos")
    with pytest.raises(FormatError, match=r"a world with a world.json, or a package .*, got a folder with neither"):
        World.open(tmp_path / "photos")


def test_a_world_is_not_taken_for_a_package(city: Path) -> None:
    with pytest.raises(FormatError, match=r"a package with a manifest.json, got a world; give one of its tiles"):
        Package.open(city)


def test_the_manifest_names_no_path(city: Path, scene: Scene) -> None:
    text = (city / "world.json").read_text()
    assert str(Path(scene[0]).parent) not in text
    assert json.loads(text)["format"] == "gsvis-world"
