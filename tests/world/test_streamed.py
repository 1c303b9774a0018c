"""A world is streamed as one scene: across borders, nothing twice, from memory or from kept tables."""

from __future__ import annotations

import asyncio
import json
import logging
import shutil
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks._worlds import small_street
from gsvis.abr import candidates
from gsvis.abr.candidate_sets import Candidates
from gsvis.abr.classes import FieldOfView
from gsvis.abr.config import AbrConfig
from gsvis.abr.piecewise import tables_of
from gsvis.abr.seen import SeenSets
from gsvis.abr.tables import CandidateTables
from gsvis.color.fit import FitConfig
from gsvis.errors import FormatError
from gsvis.files.cache import Cache
from gsvis.prepare.colors import ColorConfig
from gsvis.pvs.codec import ids_in, ids_of
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.view_sampling import ViewSampling
from gsvis.serve import Address, Server, StreamClient, open_scenes
from gsvis.stream import Quality, Receiver, Session, StreamedScene
from gsvis.train.levels import LevelsConfig
from gsvis.world import Tile, World
from gsvis.world.cells import WorldSets
from gsvis.world.prepare import prepare_world
from gsvis.world.streamed import WorldSource, open_world
from tests.made_once import make_once
from tests.serve.servers import ask, until
from tests.world.cities import config, street, write, write_city, write_long_city

VIEW = FieldOfView.from_degrees(90, 70, margin=8)


@pytest.fixture(scope="module")
def city(shared_folder: Path) -> Path:
    return make_once(shared_folder, "city", write_city) / "city.gsworld"


@pytest.fixture(scope="module")
def far(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A world so long that some districts are seen, and some are not, children of those that are seen among them."""
    folder, options = tmp_path_factory.mktemp("far"), replace(config(most=400), angle=0.3)
    package = replace(options.package, sets=replace(options.package.sets, probes=0))  # so that some of it is never seen
    options = replace(options, package=package)
    scene = write(small_street(houses=4, step=0.5, flyaways=12), folder / "street.ply")
    prepare_world([scene], folder / "c.gsworld", options)
    return folder / "c.gsworld"


@pytest.fixture(scope="module")
def leveled(shared_folder: Path) -> Path:
    return make_once(shared_folder, "long-city", write_long_city) / "city.gsworld"


@pytest.fixture(scope="module")
def shiny(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A world with view-dependent colors."""
    folder, g = tmp_path_factory.mktemp("shiny"), street()
    higher = 0.3 * np.random.default_rng(0).normal(size=(len(g), 3, 3))
    scene = write(Gaussians(g.means, g.quats, g.scales, g.opacities, g.sh0, higher), folder / "s.ply")
    colors = ColorConfig(FitConfig(max_terms=1, mean_terms=1.0), ViewSampling(2, 32, 24))
    options = config(most=900)
    prepare_world([scene], folder / "b.gsworld", replace(options, package=replace(options.package, colors=colors)))
    return folder / "b.gsworld"


@pytest.fixture
def copy(city: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(city, tmp_path / "copy.gsworld"))


def walk(scene: StreamedScene, steps: int = 80) -> tuple[list[bytes], Receiver, list[int]]:
    """Messages of a walk from one end of the world to the other and back to the middle, and what arrived."""
    config = AbrConfig(start_rate=5e5, fill=False)
    session, receiver, found, came = Session(scene, VIEW, config), Receiver(scene.header), [], []
    session.welcome(0.0)
    session.on_ack(0.0, 0)
    low, high = scene.index.grid.centers.min(axis=0), scene.index.grid.centers.max(axis=0)
    for k in range(steps):
        t, along = 0.1 * (k + 1), min(k / (0.6 * steps), 1.6 - k / steps)
        session.on_pose(t, low + along * (high - low), (0.5, -0.5, 0.5, -0.5))
        message = session.next_message(t, 1e5)
        if message is not None:
            found.append(message.data)
            came += receiver.receive(message.data).gaussians.tolist()
            session.on_ack(t + 0.02, message.sequence)
    return found, receiver, came


def test_ids_are_those_of_nodes_behind_each_other(city: Path) -> None:
    package = WorldSource.open(city)
    contents = package.read_contents()
    assert len(contents) == package.bases[-1] == package.manifest.gaussians
    for node in package.nodes:
        with package.world.package(node) as own:
            some = slice(*package.bases[node : node + 2].tolist())
            mine, theirs = contents.gaussians(np.arange(some.start, some.stop)), own.contents.gaussians()
            assert np.array_equal(mine.means, theirs.means)
            assert np.array_equal(mine.scales, theirs.scales)
            low, high = package.manifest.grids.base[0]
            assert np.abs(mine.sh0 - theirs.sh0).max() <= 1.01 * (high - low) / 255 / 0.28209 / 2 * 1.2


def seen_districts(world: World) -> set[int]:
    tables = [tile.beyond for tile in world.manifest.tiles if tile.beyond is not None]
    return {piece.node for table in tables for piece in table.pieces} - set(range(len(world.manifest.tiles)))


def test_districts_that_no_cell_sees_have_no_ids(far: Path) -> None:
    world = World.open(far)
    package, tiles, seen = WorldSource(world), len(world.manifest.tiles), seen_districts(world)
    assert 0 < len(seen) < len(world.manifest.districts)
    assert package.nodes == [*range(tiles), *sorted(seen)]
    unseen = set(range(tiles, len(world))) - seen
    assert any(unseen & set(world.manifest.districts[k - tiles].children) for k in seen)
    assert all((package.bases[k + 1] > package.bases[k]) == (k < tiles or k in seen) for k in range(len(world)))


def test_a_district_is_replaced_by_all_of_its_tiles(far: Path) -> None:
    """What replaces it, and what replaces that, ends at the lowest levels of its tiles, whichever nodes lack ids."""
    world, index = World.open(far), open_world(far)[0].index
    bases, tiles = WorldSource(world).bases, len(world.manifest.tiles)
    for node in sorted(seen_districts(world)):
        reached = set(range(*bases[node : node + 2].tolist()))
        waiting = list(reached)
        while waiting:
            some = slice(*index.replacement_offsets[waiting[-1] : waiting.pop() + 2].tolist())
            fresh = set(index.replacement_ids[some].tolist()) - reached
            reached |= fresh
            waiting += fresh
        for tile in world.manifest.districts[node - tiles].tiles:
            with world.package(tile) as own:
                lowest = np.flatnonzero(own.contents.first == own.contents.first.min())
            assert set((bases[tile] + lowest).tolist()) <= reached


def test_the_levels_of_all_nodes_are_those_of_the_world(leveled: Path) -> None:
    """The lowest level of a node stands in all levels below, and each level of a tile is that of the world."""
    world, index = World.open(leveled), open_world(leveled)[0].index
    package = WorldSource(world)
    assert package.nodes == [*range(len(world.manifest.tiles)), *sorted(seen_districts(world))]
    assert index.level_names == ("low", "high")
    counts = np.zeros(2, int)
    for node in package.nodes:
        some = slice(*package.bases[node : node + 2].tolist())
        first, last = index.first[some], index.last[some]
        with world.package(node) as own:
            members, names = own.contents.levels(), own.manifest.names
        for k in range(2):
            level = members.member(max(0, k + len(names) - 2))
            assert np.array_equal((first <= k) & (k <= last), level)
            counts[k] += np.count_nonzero(level)
    assert package.manifest.counts == tuple(counts)
    assert {len(tile.levels) for tile in world.manifest.tiles} == {1, 2}


def test_a_viewer_of_the_highest_level_gets_all_that_stands_for_it_around_a_tile(leveled: Path) -> None:
    """A far tile stands at a lower level: the Gaussians of this level alone are sent, as those of districts are."""
    world, (scene, _) = World.open(leveled), open_world(leveled)
    index, bases = scene.index, scene.source.bases  # type: ignore[attr-defined]
    alone = 0
    for cell in range(len(index.grid)):
        tile = int(index.grid.tiles[cell])
        beyond = world.beyond(tile)
        assert beyond is not None
        wanted = set[int]()
        for seen in beyond.of_cell(int(index.grid.places[cell])):
            node, ids = world.manifest.node(seen.node), bases[seen.node] + seen.ids
            top = seen.level + 2 - len(node.levels) if isinstance(node, Tile) else 1
            wanted |= set(ids[(index.first[ids] <= top) & (top <= index.last[ids])].tolist())
        beyond.close()
        session, held = Session(scene, VIEW, AbrConfig(start_rate=1e9, fill=False)), set[int]()
        session.welcome(0.0)
        session.on_ack(0.0, 0)
        for k in range(20):
            session.on_pose(0.1 * k + 0.1, index.grid.centers[cell], (0.5, -0.5, 0.5, -0.5))
            if (message := session.next_message(0.1 * k + 0.1, 1e6)) is None:
                break
            held |= set(message.batch.gaussians.tolist())
            session.on_ack(0.1 * k + 0.11, message.sequence)
        alone += sum(index.last[g] == 0 for g in wanted & held)
        assert session.planner.regime == "high"
        assert wanted <= held | set(ids_of(session.holdings.gone).tolist())
    assert alone > 0


def test_a_viewer_crosses_borders_and_gets_nothing_twice(city: Path, tmp_path: Path) -> None:
    scene, _ = open_world(city)
    found, receiver, came = walk(scene)
    assert len(came) == len(set(came))
    tiles = np.searchsorted(scene.source.bases, np.array(came), "right") - 1  # type: ignore[attr-defined]
    assert len(set(tiles.tolist()) & set(range(len(World.open(city).manifest.tiles)))) > 2
    first, tables = open_world(city, tables=tmp_path)
    again, _ = open_world(city, tables=tmp_path)
    assert tables is not None
    assert walk(first)[0] == walk(again)[0] == found
    assert again.index.sets.open_tiles > 1  # type: ignore[attr-defined]
    assert len(receiver.shown()) <= len(came)


@pytest.mark.parametrize("quality", [None, Quality()])
@pytest.mark.parametrize("degree", [0, 1])
def test_tables_made_node_by_node_are_those_of_the_whole(
    far: Path, shiny: Path, tmp_path: Path, degree: int, quality: Quality | None
) -> None:
    scene, kept = open_world(shiny if degree else far, tables=tmp_path, quality=quality)
    assert kept is not None
    assert not [each for each in tmp_path.iterdir() if each.is_dir()]
    found = scene.candidates.tables
    expected = tables_of(scene.index, stored=found.numbers.stored)
    for name, number in asdict(found.numbers).items():
        assert number == pytest.approx(getattr(expected.numbers, name), rel=1e-5), name
    mine, theirs = arrays_of(found), arrays_of(expected)
    assert mine.keys() == theirs.keys()
    for name, array in mine.items():
        other = theirs[name]
        flags = array.flags.writeable, other.flags.writeable
        assert (array.dtype, array.shape, flags[0]) == (other.dtype, other.shape, flags[1]), name
        if name == "everything level_bytes":  # a sum of the whole in single precision
            assert np.allclose(array, other, rtol=1e-5)
        else:
            assert np.array_equal(array, other), name
    if quality is None:
        contents = scene.contents
        assert np.array_equal(scene.records.parts, scene.coding.split_records(contents))
        assert np.array_equal(scene.records.term_records, contents.term_records)
        assert np.array_equal(scene.records.chunks, contents.chunks)
        assert np.array_equal(scene.records.starts, contents.table.starts)
    assert bool(len(found.owners)) == bool(degree)


def arrays_of(tables: CandidateTables) -> dict[str, np.ndarray]:
    """Return all arrays of tables, those within named tuples, too."""
    found: dict[str, Any] = {field.name: getattr(tables, field.name) for field in fields(tables)}
    found |= {f"everything {each.name}": getattr(tables.everything, each.name) for each in fields(Candidates)}
    for name, value in list(found.items()):
        if isinstance(value, tuple):
            found |= {f"{name} {part}": array for part, array in zip(value._fields, value, strict=True)}
    return {name: value for name, value in found.items() if isinstance(value, np.ndarray)}


def test_a_tile_may_have_fewer_levels_than_the_world(tmp_path: Path) -> None:
    """As what lies outside mostly does. Its lowest level stands in all lower ones of the world."""
    levels = LevelsConfig((0.3,), (0.9,), ("low", "high"), iterations=3, preview=0.1, preview_from=0)
    path = tmp_path / "city.gsworld"
    prepare_world([write(street(), tmp_path / "street.ply")], path, config(levels, most=4000))
    world = World.open(path)
    counts = [len(tile.levels) for tile in world.manifest.tiles]
    assert min(counts) < max(counts) == 2
    for tables in (None, tmp_path):
        scene, _ = open_world(path, tables=tables, quality=Quality())
        assert isinstance(scene.source, WorldSource)
        few = slice(*scene.source.bases[np.argmin(counts) :][:2])
        assert (scene.index.first[few] == 0).all()
        assert len(scene.candidates.tables.links.ending)
        assert len(walk(scene)[2])


@pytest.mark.parametrize("dense", [True, False])
@pytest.mark.parametrize("away", [0.0, 100.0])
def test_an_idle_link_ends_with_all_records_of_all_tiles(
    far: Path, dense: bool, away: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each once, and nothing else is shown then; what is kept for shells stays within its bound."""
    monkeypatch.setattr(candidates, "_DENSE", 1 << 16 if dense else 0)
    monkeypatch.setattr(candidates, "_REST", 16)
    scene, _ = open_world(far)
    index, recent = scene.index, scene.candidates.shells.recent
    session, receiver, came = Session(scene, VIEW, AbrConfig(start_rate=1e9)), Receiver(scene.header), []
    session.welcome(0.0)
    session.on_ack(0.0, 0)
    session.on_pose(0.1, index.grid.centers[0] + [0.0, 0.0, away], (0.5, -0.5, 0.5, -0.5))
    while (message := session.next_message(0.2, 1e5)) is not None:
        came += receiver.receive(message.data).gaussians.tolist()
        session.on_ack(0.2, message.sequence)
        assert recent.nbytes <= recent.max_bytes
    wanted = np.flatnonzero((index.last == index.num_levels - 1) & (np.diff(index.replacement_offsets) == 0))
    seen = np.unique(np.concatenate([index.sets.classes(cell)[0] for cell in range(len(index.grid))]))
    assert len(np.setdiff1d(wanted, seen)) > 0
    assert len(came) == len(set(came))
    assert set(wanted.tolist()) <= set(came)
    assert np.array_equal(np.sort(receiver.shown()), wanted)


def test_all_that_a_cell_sees_arrives(city: Path) -> None:
    """From each cell: what its tile's sets and the table of what lies beyond say, and what was held before."""
    scene, _ = open_world(city)
    world, bases = World.open(city), scene.source.bases  # type: ignore[attr-defined]
    cells = scene.index.grid
    for cell in range(len(cells)):
        tile, place = int(cells.tiles[cell]), int(cells.places[cell])  # type: ignore[attr-defined]
        with world.package(tile) as package:
            expected = set((package.visibility.classes(place)[0] + bases[tile]).tolist())
        beyond = world.beyond(tile)
        if beyond is not None:
            for seen in beyond.of_cell(place):
                expected |= set((seen.ids + bases[seen.node]).tolist())
            beyond.close()
        assert set(scene.index.sets.classes(cell)[0].tolist()) == expected
        assert scene.index.grid.nearest(cells.centers[cell]) >= 0


def test_what_is_decoded_of_all_tiles_is_in_one_cache(city: Path) -> None:
    scene, _ = open_world(city)
    for cell in range(len(scene.index.grid)):
        scene.candidates.in_cell(cell)
    sets, kinds = scene.index.sets, {key[0] for key in scene.candidates.cache._values}
    assert isinstance(sets, WorldSets)
    tiles = sets._tiles._values
    assert {("tile", tile) for tile in tiles} <= kinds
    stores = [store for tile, _ in tiles.values() for store in (tile.own, tile.beyond.store)]
    assert all(store.cache.find(("set", 0)) is not None and not store.cache.nbytes for store in stores)
    assert scene.candidates.cache.nbytes <= scene.candidates.cache.max_bytes


def test_cells_touch_across_borders(city: Path) -> None:
    cells = open_world(city)[0].index.grid
    across = 0
    for cell in range(len(cells)):
        rings = cells.rings(cell)  # type: ignore[attr-defined]
        assert sorted(k for ring in rings for k in ring) == sorted([cell, *cells.neighbors(cell).tolist()])
        across += sum(cells.tiles[k] != cells.tiles[cell] for k in rings[1])  # type: ignore[attr-defined]
        for other in cells.neighbors(cell).tolist():
            assert cell in cells.neighbors(other).tolist() or cells.sizes[cell] != cells.sizes[other]  # type: ignore[attr-defined]
    assert across > 0


@pytest.fixture(params=["missing", "damaged"])
def broken(request: pytest.FixtureRequest, copy: Path) -> Path:
    """A world whose tile 1 is missing, or has a damaged part."""
    folder = World.open(copy).package_path(1)
    if request.param == "missing":
        shutil.rmtree(folder)
    else:
        part = max(folder.glob("parts/*.bin"), key=lambda path: path.stat().st_size)
        part.write_bytes(part.read_bytes()[:-1] + b"?")
    return copy


def test_a_tile_that_cannot_be_read_is_left_out_with_one_line(
    broken: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.ERROR, logger="gsvis.world"):
        scene, _ = open_world(broken, tables=tmp_path / "t")
        _, _, came = walk(scene)
    assert len(came) == len(set(came)) > 0
    lines = [record.getMessage() for record in caplog.records]
    assert any("tile 1 " in line for line in lines)
    assert len(lines) == len(set(lines))


def test_a_world_without_a_tile_that_can_be_read_is_refused(copy: Path) -> None:
    world = World.open(copy)
    for tile in range(len(world.manifest.tiles)):
        shutil.rmtree(world.package_path(tile))
    with pytest.raises(FormatError, match="a tile that can be read"):
        open_world(copy)


def check_facts(server: Server, grid: Any, gaussians: int) -> None:
    """The floor covers the cells; a Gaussian of a tile knows its cells, one of a district is known."""
    floor = json.loads(ask(server, "/scenes/city/floor")[2])
    assert json.loads(ask(server, "/scenes/city/seen")[2]) is None
    heights = np.array([value for value in floor["heights"] if value is not None])
    steps = np.stack(np.meshgrid(np.arange(floor["columns"]), np.arange(floor["rows"])), axis=-1).reshape(-1, 2) + 0.5
    places = floor["origin"] + floor["side"] * steps @ np.array([floor["first"], floor["second"]])
    over = np.abs(places[:, None, :2] - grid.centers[:, :2]).max(axis=2) <= grid.sizes / 2
    assert over.any(axis=1).tolist() == [value is not None for value in floor["heights"]]
    assert len(heights)
    low, high = grid.centers[:, 2].min() - grid.sizes.max() / 2, grid.centers[:, 2].max() + grid.sizes.max() / 2
    assert low <= heights.min() <= heights.max() <= high
    seen = [json.loads(ask(server, f"/scenes/city/why/{k}")[2]) for k in (0, 40, gaussians - 1)]
    assert seen[0]["cells"]["of"] >= 1
    assert any(each["cells"]["seeing"] for each in seen[:2])
    assert seen[2]["cells"] is None
    assert ask(server, f"/scenes/city/why/{gaussians}")[0] == 404


def check_files(server: Server, city: Path) -> None:
    """A copy of the world can be fetched file by file, and nothing else."""
    for path in sorted(city.rglob("*")):
        if path.is_file():
            status, _, data = ask(server, f"/packages/city/{path.relative_to(city).as_posix()}")
            assert status == 200
            assert data == path.read_bytes()
    for wrong in ("packages/../world.json", "packages/" + "0" * 64 + "/manifest.json", "beyond/x.pvs", "manifest.json"):
        assert ask(server, f"/packages/city/{wrong}")[0] in (400, 404)


def test_cells_of_a_world_hold_their_points(city: Path) -> None:
    cells: Any = open_world(city)[0].index.grid
    points = np.random.default_rng(0).uniform(cells.corners().min(axis=0), cells.corners().max(axis=0), (2000, 3))
    inside = (np.abs(points[:, None] - cells.centers) <= cells.sizes[:, None] / 2).all(axis=2)
    found = cells.cell_at(points)
    assert ((found >= 0) == inside.any(axis=1)).all()
    held = found >= 0
    assert inside[held, found[held]].all()


def test_a_server_streams_a_world(city: Path, tmp_path: Path) -> None:
    """A client walks through it, over a real socket."""

    async def stream(url: str) -> StreamClient:
        client = StreamClient(url, VIEW)

        def pose(t: float) -> tuple[tuple[float, ...], tuple[float, ...]]:
            x, y, z = (low + min(t / 3.0, 1.0) * (high - low)).tolist()
            return (x, y, z), (0.5, -0.5, 0.5, -0.5)

        await client.run(pose, seconds=5.0)
        return client

    with open_scenes([city], tables=tmp_path) as scenes:
        grid = scenes["city"].scene.index.grid
        low, high = grid.centers.min(axis=0), grid.centers.max(axis=0)
        server = Server(scenes, None, Address(port=0))
        with server.running() as url:
            client = asyncio.run(stream(url))
            assert client.receiver is not None
            assert len(client.receiver.shown()) > 1000
            assert ask(server, "/scenes/city/cells")[0] == 404
            check_facts(server, grid, len(scenes["city"].scene))
            check_files(server, city)
            assert b'"manifest":null' in ask(server, "/")[2]
        until(lambda: scenes["city"].users == 0)
        assert scenes["city"].close_unused(1e12, 1.0)
        scenes["city"].use()


def test_a_tile_that_is_opened_ahead_answers_as_one_that_is_not(city: Path) -> None:
    index, other = open_world(city)[0].index, open_world(city)[0].index
    grid: Any = index.grid
    sets = index.sets
    bases = WorldSource.open(city).bases
    for cell in range(0, len(grid), 7):
        tile, near = int(grid.tiles[cell]), sets.tiles_near(cell)
        assert set(near) == {tile, *grid.tiles[grid.neighbors(cell)].tolist()}
        assert near[tile] == (bases[tile] / bases[-1], bases[tile + 1] / bases[-1])
        for each in near:
            sets.load(each)
            assert sets.is_open(each)
        for mine, theirs in zip(sets.visible_masks(cell), other.sets.visible_masks(cell), strict=True):
            assert np.array_equal(mine, theirs)
        assert np.array_equal(ids_in(*sets.visible_masks(cell)), sets.classes(cell)[0])


def test_sets_whose_order_the_tables_hold_are_those_that_know_none(copy: Path) -> None:
    scene, _ = open_world(copy)
    package, known = scene.source, scene.index.sets
    assert isinstance(package, WorldSource)
    assert isinstance(known, WorldSets)
    other = package.sets(scene.index.grid, Cache(), {"last": scene.index.last})
    for cell in range(len(scene.index.grid)):
        for mine, theirs in zip(known.visible_masks(cell), other.visible_masks(cell), strict=True):
            assert np.array_equal(mine, theirs)
    orders = {(("tile", tile), "order") for tile in scene.index.grid.tiles.tolist()}  # type: ignore[attr-defined]
    assert not orders & set(known._cache._values)
    assert orders <= set(other._cache._values)
    with package.world.package(0) as own:
        assert np.array_equal(package.piece_order(0), own.visibility.order)
        for part in own.manifest.visibility.parts:
            path = package.world.package_path(0) / "parts" / part.name
            path.write_bytes(bytes(path.stat().st_size))
    assert np.array_equal(package.piece_order(0), np.full(own.manifest.gaussians, -1))


@pytest.mark.parametrize("damaged", [False, True])
def test_rings_that_are_joined_as_they_are_stored_hold_what_their_cells_see(
    far: Path, tmp_path: Path, damaged: bool
) -> None:
    """Across borders, with what lies beyond the tiles, and where a tile is damaged: then its cells see all of it."""
    copy = Path(shutil.copytree(far, tmp_path / "copy.gsworld"))
    scene, _ = open_world(copy)
    cells, seen = scene.index.grid, SeenSets(scene.index, Cache())
    if damaged:
        with World.open(copy).package(int(cells.tiles[0])) as own:  # type: ignore[attr-defined]
            for part in own.manifest.visibility.parts:
                (own.path / "parts" / part.name).write_bytes(bytes(part.nbytes))
    across = 0
    for cell in range(len(cells)):
        rings = cells.rings(cell)
        across += len(set(cells.tiles[[k for ring in rings for k in ring]].tolist())) > 1  # type: ignore[attr-defined]
        fresh, every = seen.join(seen.of_rings(rings))
        expected, all_of_them = seen.join([[seen.of_cell(each) for each in ring] for ring in rings])
        for mine, theirs in zip([*fresh, every], [*expected, all_of_them], strict=True):
            assert np.array_equal(mine.words, theirs.words)
            assert np.array_equal(mine.masks, theirs.masks)
    assert across > 0
