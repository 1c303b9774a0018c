"""The static form of a scene, read back by a reader of this file alone, as docs/static.md describes it."""

from __future__ import annotations

import hashlib
import json
import zlib
from collections.abc import Iterator
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gsvis.color.storage import grids_of
from gsvis.errors import FormatError
from gsvis.export import StaticOptions, write_static
from gsvis.export.bare import Harmonics
from gsvis.export.coded import HEAD
from gsvis.export.start import start_poses
from gsvis.files.fields import parse_object
from gsvis.package import ChunkTable, Package, RecordLayout, decode_records
from gsvis.package.codec import unpack_bits
from gsvis.scene.gaussians import Gaussians, rotations_from_quats
from gsvis.scene.levels import Levels
from gsvis.scene.procedural import random_scene
from gsvis.scene.sh import SH_C0
from gsvis.stream.coding import Coding, chunks_of, table_sizes
from gsvis.stream.tables import Tables
from tests.package.worlds import levels_of
from tests.stream.worlds import package_of


class Columns:
    """Columns of numbers, one after the other."""

    def __init__(self, data: bytes, count: int) -> None:
        self.data, self.count, self.at = zlib.decompress(data), count, 0

    def next(self, width: int, count: int | None = None) -> np.ndarray:
        n, found = self.count if count is None else count, 0
        for k in range(width):
            found = found + (np.frombuffer(self.data, np.uint8, n, self.at).astype(np.int64) << 8 * k)
            self.at += n
        return np.asarray(found)

    def sums(self, width: int) -> np.ndarray:
        folded = self.next(width)
        return np.cumsum(np.where(folded % 2, -(folded + 1) // 2, folded // 2))


class Reader:
    """A scene read by the rules of docs/static.md."""

    def __init__(self, folder: Path) -> None:
        self.scene = json.loads((folder / "scene.json").read_bytes())
        self.data: dict[str, bytes] = {}
        for kind, file in self.scene["files"].items():
            self.data[kind] = data = (folder / file["name"]).read_bytes()
            assert len(data) == file["bytes"]
            assert file["name"] == f"{kind}-{hashlib.sha256(data).hexdigest()[:16]}.bin"
        c = self.scene["chunks"]
        columns = Columns(self.data["index"], c)
        places = np.stack([columns.sums(3) for _ in range(3)], axis=1)
        said = self.scene["places"]
        self.centers = np.array(said["middle"]) + said["scale"] * np.sinh(places / 64)
        self.radii = said["scale"] * 2.0 ** ((columns.next(1) - 128) / 4)
        self.counts = columns.next(1) + 1
        self.levels = np.stack([columns.next(1), columns.next(1)], axis=1)
        units = columns.next(2, self.scene["blocks"])
        assert columns.at == len(columns.data)
        self.record_starts = np.concatenate([[0], np.cumsum(16 * units)])
        assert self.record_starts[-1] == len(self.data["records"])
        self.blocks: list[tuple[int, int, int]] = []  # chunk, first id, count
        starts = np.concatenate([[0], np.cumsum(self.counts)])
        pairs = [(int(first), int(last)) for first, last in self.levels]
        low = 0
        while low < len(pairs):
            high = low
            while high < len(pairs) and pairs[high] == pairs[low]:
                high += 1
            for stratum in range(4):
                for chunk in range(low, high):
                    count = min(64, int(self.counts[chunk]) - 64 * stratum)
                    if count > 0:
                        self.blocks.append((chunk, int(starts[chunk]) + 64 * stratum, count))
            low = high
        self.starts = np.concatenate([[0], np.cumsum([count for _, _, count in self.blocks])])

    @property
    def ids(self) -> np.ndarray:
        return np.concatenate([np.arange(first, first + count) for _, first, count in self.blocks])

    @cached_property
    def coding(self) -> Coding | None:
        """The code of the records; None where they are as they are."""
        if self.scene["code"] is None:
            return None
        grids = grids_of(
            parse_object("scene.json", json.dumps(self.scene["colors"]).encode()), self.scene["colors"]["variant"]
        )
        return Coding(grids, None, Tables.from_text(self.scene["code"], table_sizes(grids)))

    @cached_property
    def heads(self) -> np.ndarray:
        """(B,) heads of blocks."""
        rows = [self.data["records"][at : at + HEAD.itemsize] for at in self.record_starts[:-1]]
        return np.frombuffer(b"".join(rows), HEAD)

    def records(self) -> np.ndarray:
        """Records by id."""
        out = np.empty((self.scene["gaussians"], 16), np.uint8)
        for (chunk, first, count), head, at in zip(self.blocks, self.heads, self.record_starts, strict=False):
            body = self.data["records"][at + HEAD.itemsize : at + HEAD.itemsize + 2 * int(head["words"])]
            if self.coding is None:
                out[first : first + count] = np.frombuffer(body, np.uint8).reshape(count, 16)
                continue
            ids, of = np.arange(count), np.full(count, chunk, np.int32)
            found = self.coding.decode_records(np.frombuffer(body, np.uint8), ids, of, chunks_of(self.table()))
            assert found is not None
            out[first : first + count] = found
        return out

    def replaced(self, block: int) -> list[list[int]]:
        """The blocks that replace each Gaussian of a block that ends below the highest level."""
        head, last, out = self.heads[block], 0, list[list[int]]()
        at, end = self.record_starts[block] + HEAD.itemsize + 2 * int(head["words"]), self.record_starts[block + 1]
        row = iter(self.data["records"][at:end])
        for _ in range(self.blocks[block][2]):
            out.append([])
            for _ in range(next(row)):
                digits = [next(row)]
                while digits[-1] > 127:
                    digits.append(next(row))
                folded = sum((digit & 127) << 7 * k for k, digit in enumerate(digits))
                last += -(folded + 1) // 2 if folded % 2 else folded // 2
                out[-1].append(last)
        rest = bytes(row)
        assert len(rest) < 16
        assert not any(rest)
        return out

    def layers(self) -> list[list[list[bytes]]]:
        """Records of terms of each layer, by id."""
        count, layers = len(self.blocks), self.scene["term_layers"]
        columns, at = Columns(self.data["blocks"], count * layers), 0
        out: list[list[list[bytes]]] = [[[] for _ in range(self.scene["gaussians"])] for _ in range(layers)]
        for item, words in enumerate(columns.next(2)):
            _, first, members = self.blocks[item % count]
            data, at = self.data["terms"][at : at + 2 * words], at + 2 * int(words)
            if not words:
                continue
            bits = np.unpackbits(np.frombuffer(data, np.uint8), bitorder="little")
            whole = int(np.searchsorted(np.cumsum(1 - bits), members)) + 1  # up to the zero of the last Gaussian
            owners = np.cumsum(1 - bits[:whole])[bits[:whole] == 1]  # Gaussians that have ended before
            head = -(-whole // 16) * 16
            assert not bits[whole:head].any()
            assert self.coding is not None
            found = self.coding.decode_terms(np.frombuffer(data, np.uint8)[head // 8 :], owners)
            assert found is not None
            for owner, row in zip(owners.tolist(), found, strict=True):
                out[item // count][first + owner].append(row.tobytes())
        assert at == len(self.data["terms"])
        return out

    def terms(self) -> list[list[bytes]]:
        """Records of terms by id, sorted."""
        layers = self.layers() if "terms" in self.data else []
        return [sorted(record for layer in layers for record in layer[k]) for k in range(self.scene["gaussians"])]

    def cells(self) -> list[tuple[np.ndarray, np.ndarray, np.ndarray | None]]:
        """Visible blocks and gains of each cell, and by layer what terms are worth."""
        columns = Columns(self.data["grid"], self.scene["cells"]["count"])
        self.boxes = np.stack([columns.sums(4) for _ in range(3)], axis=1)
        out, at, bits = [], 0, -(-len(self.blocks) // 8)
        for size in columns.next(4):
            data, at = zlib.decompress(self.data["cells"][at : at + size]), at + int(size)
            seen = np.flatnonzero(np.unpackbits(np.frombuffer(data[:bits], np.uint8), bitorder="little"))
            gains = 2.0 ** ((np.frombuffer(data[bits : bits + len(seen)], np.uint8) - 255.0 + self.top) / 4)
            rest, worth = data[bits + len(seen) :], None
            if self.scene["cells"]["active"]:
                octaves = np.frombuffer(rest, np.uint8).reshape(self.scene["term_layers"], len(seen))
                worth = np.where(octaves > 0, 2.0 ** (octaves - 128.0), 0.0)
            else:
                assert rest == b""
            out.append((seen, gains, worth))
        assert at == len(self.data["cells"])
        return out

    @property
    def top(self) -> int:
        return int(self.scene["cells"]["gain_top"])

    def table(self) -> ChunkTable:
        of = {chunk: k for k, (chunk, _, _) in enumerate(self.blocks)}
        heads = self.heads[[of[chunk] for chunk in range(len(self.counts))]]
        columns = (np.ascontiguousarray(heads[k]) for k in ("origin", "step", "low", "stride"))
        return ChunkTable(*columns, self.counts, unpack_bits(heads["bits"], 14))


def ids_in_package(package: Package) -> np.ndarray:
    """Id in the package of each id of its static form: within a chunk by the sum of weight times cross-section."""
    from gsvis.abr.index import extents
    from gsvis.stream.source import class_weights

    g, sets, starts = package.contents.gaussians(), package.visibility, package.contents.table.starts
    total = np.zeros(len(g))
    for cell in range(len(sets)):
        ids, classes = sets.classes(cell)
        total[ids] += class_weights(sets)[classes]
    total *= extents(g)[1]
    chunks = [range(int(low), int(high)) for low, high in pairwise(starts)]
    return np.array([k for chunk in chunks for k in sorted(chunk, key=lambda k: -total[k])])


@pytest.fixture
def package(tmp_path: Path) -> Iterator[Package]:
    with package_of(tmp_path / "s.gsvis", 700) as made:
        yield made


def test_a_package_reads_back_record_by_record(package: Package, tmp_path: Path) -> None:
    made = write_static(tmp_path / "out", package, StaticOptions(name="two rooms"))
    read, contents = Reader(tmp_path / "out"), package.contents
    assert sorted(read.ids) == list(range(700))
    ids = ids_in_package(package)
    assert np.array_equal(read.records(), contents.records[ids])
    offsets, terms = contents.term_offsets, read.terms()
    for k, i in enumerate(ids):
        assert terms[k] == sorted(row.tobytes() for row in contents.term_records[offsets[i] : offsets[i + 1]])
    assert np.array_equal(read.levels, contents.chunk_levels)
    assert (read.scene["name"], read.scene["up"]) == ("two rooms", [0, -1, 0])
    assert made.nbytes == sum(len(data) for data in read.data.values())
    assert (made.gaussians, made.terms, made.blocks) == (700, len(contents.term_records), len(read.blocks))


def test_no_gaussian_of_a_chunk_reaches_further_than_it_says(package: Package, tmp_path: Path) -> None:
    write_static(tmp_path / "out", package)
    read, g, table = Reader(tmp_path / "out"), package.contents.gaussians(), package.contents.table
    chunks, starts = package.contents.chunks, table.starts[:-1]
    away = np.linalg.norm(g.means - read.centers[chunks], axis=1)
    reach = np.maximum.reduceat(away, starts) + 3.0 * np.maximum.reduceat(g.scales.max(axis=1), starts)
    assert (reach <= read.radii * (1 + 1e-9)).all()
    assert (read.radii <= reach * 2 ** (1.01 / 4)).all()


def test_a_cell_lists_the_blocks_that_it_sees_and_what_they_and_their_terms_are_worth(
    package: Package, tmp_path: Path
) -> None:
    from gsvis.abr.index import extents
    from gsvis.color.activation import contributions
    from gsvis.stream.source import class_weights

    write_static(tmp_path / "out", package)
    read, g = Reader(tmp_path / "out"), package.contents.gaussians()
    areas, means = extents(g)[1].astype(float), g.means.astype(float)
    sets, contents, active = package.visibility, package.contents, package.active_terms
    owners, records = np.repeat(np.arange(700), contents.term_counts), contents.term_records
    cells, of, layers = read.cells(), ids_in_package(package), read.layers()
    assert len(cells) == len(sets)
    for cell, (seen, gains, worth) in enumerate(cells):
        ids, classes = sets.classes(cell)
        middle, side = sets.grid.centers[cell], sets.grid.cell_size
        away = np.maximum(((means - middle) ** 2).sum(axis=1), (side / 2) ** 2)
        light = np.zeros(700)
        light[ids] = class_weights(sets)[classes] * np.minimum(areas / away, 4 * np.pi)[ids]
        changes = contributions(contents.colors().dequantize(), g.means, middle)
        values: dict[tuple[int, bytes], float] = {}  # terms that are active here
        for t in active.active_ids(cell).tolist():
            values[int(owners[t]), records[t].tobytes()] = max(changes[t], active.epsilon) ** 2 * light[owners[t]]
        wanted = []
        for block, (_, first, count) in enumerate(read.blocks):
            members = of[first : first + count]
            if np.isin(members, ids).any():
                wanted.append(block)
                place = len(wanted) - 1
                assert np.isclose(np.log2(gains[place]), np.log2(light[members].sum()), atol=0.13)
                assert worth is not None
                for layer, found in zip(layers, worth[:, place], strict=True):
                    has = [(int(of[k]), record) for k in range(first, first + count) for record in layer[k]]
                    total = sum(values.get(each, 0.0) for each in has)
                    assert (found == 0.0) == (total == 0.0)
                    assert total == 0.0 or abs(np.log2(found / total)) < 0.51
        assert wanted == seen.tolist()


def test_what_ends_below_the_highest_level_names_the_fewest_blocks_that_replace_most_of_it(
    package: Package, tmp_path: Path
) -> None:
    from gsvis.abr.index import extents, nearest_replacements

    write_static(tmp_path / "out", package)
    read, contents = Reader(tmp_path / "out"), package.contents
    areas = extents(contents.gaussians())[1].astype(float)
    offsets, ids = nearest_replacements(Levels(contents.gaussians(), contents.first, contents.last, contents.names))
    block_of, of = np.empty(700, int), ids_in_package(package)
    block_of[of[read.ids]] = np.repeat(np.arange(len(read.blocks)), np.diff(read.starts))
    for block, (chunk, first, _) in enumerate(read.blocks):
        if read.levels[chunk, 1] == 2:
            continue
        for j, found in enumerate(read.replaced(block)):
            one = of[first + j]
            replacing = ids[offsets[one] : offsets[one + 1]]
            held = {b: areas[replacing[block_of[replacing] == b]].sum() for b in set(block_of[replacing].tolist())}
            named = sorted((held[b] for b in found), reverse=True)
            assert found == sorted(set(found) & set(held))
            assert named == sorted(held.values(), reverse=True)[: len(named)]
            share = 0.4 * sum(held.values())
            assert sum(named[:-1]) < share * (1 + 1e-6)
            assert sum(named) >= share * (1 - 1e-6)


def test_layers_hold_the_first_terms_and_the_others_by_the_nearest_of_four_directions(
    package: Package, tmp_path: Path
) -> None:
    from gsvis.color.srbf import unit_vectors

    write_static(tmp_path / "out", package)
    read, contents, of = Reader(tmp_path / "out"), package.contents, ids_in_package(package)
    centers, offsets = unit_vectors(contents.colors().dequantize().centers), contents.term_offsets
    corners = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
    layers = read.layers()
    assert len(layers) == 5
    for k, g in enumerate(of.tolist()):
        wanted: list[list[bytes]] = [[] for _ in layers]
        for place, t in enumerate(range(offsets[g], offsets[g + 1])):
            facing = int(np.argmax(corners @ centers[t]))
            wanted[0 if place < 2 else 1 + facing].append(contents.term_records[t].tobytes())
        assert [layer[k] for layer in layers] == wanted


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_a_bare_scene_reads_back_as_what_it_was(degree: int, tmp_path: Path) -> None:
    g = random_scene(np.random.default_rng(1), 900, sh_degree=degree)
    made = write_static(tmp_path, g)
    read = Reader(tmp_path)
    assert (made.cells, made.sh_degree, len(read.cells())) == (1, degree, 1)
    assert [level["count"] for level in read.scene["levels"]] == [900]
    assert read.cells()[0][0].tolist() == list(range(len(read.blocks)))
    found = decode_records(read.records(), read.table(), RecordLayout.from_variant("rgb"))
    apart = np.linalg.norm(found.means[:, None] - g.means[None], axis=2)
    pairs = apart.argmin(axis=1)
    assert sorted(pairs.tolist()) == list(range(900))
    assert np.allclose(found.opacities, g.opacities[pairs], atol=0.5 / 255 + 1e-6)
    assert np.allclose(np.sort(found.scales, axis=1), np.sort(g.scales[pairs], axis=1), rtol=0.04)
    from gsvis.color.records import PRECISIONS, Grids

    said = read.scene["colors"]
    red, green, blue = (tuple(pair) for pair in said["base"])
    base = red, green, blue
    grids = Grids("rgb", PRECISIONS["wire"], base, (1.0, 1.0), (1.0, 1.0), 0.0)
    rgb = np.stack([grids.base_table(k)[read.records()[:, 1 + k]] for k in range(3)], axis=1)
    span = max(high - low for low, high in base)
    assert np.abs(rgb - (0.5 + SH_C0 * g.sh0[pairs, 0])).max() < 0.02 * span
    if degree == 0:
        assert "harmonics" not in read.data
        assert read.scene["harmonics"] is None
        return
    count = (degree + 1) ** 2 - 1
    by_id = np.empty((900, 3 * count), np.uint8)
    by_id[read.ids] = np.frombuffer(read.data["harmonics"], np.uint8).reshape(900, 3 * count)
    low, high = (np.array(read.scene["harmonics"][key]) for key in ("low", "high"))
    values = low[:, None] + by_id.reshape(900, count, 3) / 255 * (high - low)[:, None]
    exact = np.clip(g.shN[pairs], low[:, None], high[:, None])
    assert (np.abs(values - exact) <= 0.51 * (high - low)[:, None] / 255).all()


def test_zero_harmonics_stay_zero_and_ends_hold_all_but_a_few() -> None:
    rng = np.random.default_rng(3)
    values = rng.normal(size=(5000, 3, 3)).astype(np.float32)
    values[:, 1] = 0.0
    values[0, 0, 0] = 1e6  # one that is out of reach
    made = Harmonics.from_coefficients(values, 1)
    back = made.decode(made.encode(values, np.arange(5000)))
    assert np.abs(back[:, 1]).max() < 1e-12
    assert made.high[0] < 100.0
    assert np.abs(back[1:, 2] - np.clip(values[1:, 2], made.low[2], made.high[2])).max() < made.high[2] / 250


def test_levels_without_a_package_keep_their_levels(tmp_path: Path) -> None:
    levels = levels_of(500)
    write_static(tmp_path, levels)
    read = Reader(tmp_path)
    assert [(each["name"], each["count"]) for each in read.scene["levels"]] == list(
        zip(levels.names, levels.counts, strict=True)
    )
    ending = [b for b, (chunk, _, _) in enumerate(read.blocks) if read.levels[chunk, 1] < len(levels) - 1]
    assert ending
    for block in ending:
        for found in read.replaced(block):
            assert found
            assert all(read.levels[read.blocks[b][0], 0] > read.levels[read.blocks[block][0], 1] for b in found)


def test_the_same_scene_gives_the_same_files_and_a_new_one_replaces_the_old(tmp_path: Path) -> None:
    g = random_scene(np.random.default_rng(1), 300, sh_degree=1)
    write_static(tmp_path / "a", g)
    rng = np.random.default_rng(5)
    write_static(tmp_path / "b", g[rng.permutation(300)])
    files = {p.name: p.read_bytes() for p in (tmp_path / "a").iterdir()}
    assert files == {p.name: p.read_bytes() for p in (tmp_path / "b").iterdir()}
    before = {p.name: p.stat().st_mtime_ns for p in (tmp_path / "a").iterdir() if p.suffix == ".bin"}
    write_static(tmp_path / "a", g, StaticOptions(name="another"))
    after = {p.name: p.stat().st_mtime_ns for p in (tmp_path / "a").iterdir() if p.suffix == ".bin"}
    assert before == after  # what is whole is not written again
    damaged = next(p for p in (tmp_path / "a").iterdir() if p.name.startswith("records"))
    damaged.write_bytes(bytes(damaged.stat().st_size))
    write_static(tmp_path / "a", g)
    assert damaged.read_bytes() == files[damaged.name]
    write_static(tmp_path / "a", g[:200])
    assert len(Reader(tmp_path / "a").ids) == 200
    assert len(list((tmp_path / "a").iterdir())) == 6


def test_a_folder_of_something_else_and_an_empty_scene_are_refused(tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("mine")
    with pytest.raises(FormatError, match=r"mine\.txt"):
        write_static(tmp_path, random_scene(np.random.default_rng(1), 5))
    with pytest.raises(FormatError, match="a file"):
        write_static(tmp_path / "mine.txt", random_scene(np.random.default_rng(1), 5))
    with pytest.raises(ValueError, match="at least one Gaussian"):
        write_static(tmp_path / "none", Gaussians.empty())
    assert not (tmp_path / "none").exists()
    with pytest.raises(ValueError, match="meters_per_unit"):
        StaticOptions(meters_per_unit=-1.0)


def test_a_package_without_sets_and_one_of_another_variant(tmp_path: Path) -> None:
    with package_of(tmp_path / "p.gsvis", 300, stores=False) as plain:
        assert write_static(tmp_path / "a", plain).cells == 1
    assert Reader(tmp_path / "a").cells()[0][2] is None
    with package_of(tmp_path / "h.gsvis", 300, "hsl") as hsl:
        write_static(tmp_path / "b", hsl)
        records = hsl.contents.records[ids_in_package(hsl)]
    read = Reader(tmp_path / "b")
    assert read.scene["colors"]["variant"] == "hsl"
    assert np.array_equal(read.records(), records)


def start_of(document: dict[str, Any]) -> tuple[np.ndarray, np.ndarray]:
    from gsvis.scene.gaussians import rotations_from_quats

    pose = document["poses"][0]
    return np.array(pose["position"]), rotations_from_quats(np.array([pose["rotation"]]))[0]


def test_it_begins_in_a_cell_upright_or_outside_of_a_bare_scene(package: Package, tmp_path: Path) -> None:
    write_static(tmp_path / "out", package)
    eye, turn = start_of(Reader(tmp_path / "out").scene)
    grid = package.visibility.grid
    assert grid.cell_at(eye[None])[0] >= 0
    assert abs(turn[:, 2] @ np.array([0, -1.0, 0])) < 1e-4
    assert turn[:, 1] @ np.array([0, -1.0, 0]) < -0.99  # the image's y points down
    g = random_scene(np.random.default_rng(1), 300)
    write_static(tmp_path / "bare", g, StaticOptions(up=(0.0, 0.0, 1.0)))
    eye, turn = start_of(Reader(tmp_path / "bare").scene)
    low, high = g.bounds(0.9)
    assert ((eye < low) | (eye > high)).any()
    assert (turn[:, 2] @ ((low + high) / 2 - eye)) > 0.99 * np.linalg.norm((low + high) / 2 - eye)


@pytest.mark.parametrize("up", [(0.0, 0.0, 1.0), (0.0, -1.0, 0.0), (0.6, 0.0, 0.8), (3**-0.5, 3**-0.5, 3**-0.5)])
@pytest.mark.parametrize("count", [1, 50])
def test_a_view_to_begin_with_is_upright_and_shows_the_middle(up: tuple[float, float, float], count: int) -> None:
    g = random_scene(np.random.default_rng(0), count)
    (start,) = start_poses(g.bounds(0.9), None, up)
    turn = rotations_from_quats(np.array([start.rotation]))[0]
    away = g.bounds(0.9).mean(axis=0) - start.position
    assert np.allclose(turn[:, 2], away / np.linalg.norm(away), atol=1e-3)
    assert abs(turn[:, 0] @ np.array(up)) < 1e-5
    assert turn[:, 1] @ np.array(up) < 0
