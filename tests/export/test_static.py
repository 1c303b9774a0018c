"""The static form of a scene, read back by a reader of this file alone, as docs/static.md describes it."""

from __future__ import annotations

import hashlib
import json
import struct
import zlib
from collections.abc import Iterator
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gsvis.color.activation import contributions
from gsvis.color.storage import grids_of
from gsvis.errors import FormatError
from gsvis.export import StaticOptions, write_static
from gsvis.export.harmonics import Harmonics, label_bytes
from gsvis.export.lights import Lights
from gsvis.export.parts import divide_in_space
from gsvis.export.start import Start, start_poses
from gsvis.files.fields import parse_object
from gsvis.package import ChunkTable, Package, RecordLayout, decode_records
from gsvis.package.codec import unpack_bits
from gsvis.package.rounding import chunks_of
from gsvis.render import view_weights
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians, rotations_from_quats
from gsvis.scene.procedural import random_scene
from gsvis.scene.sh import SH_C0
from gsvis.stream.coding import Coding, table_sizes
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

    def sums(self, width: int, count: int | None = None) -> np.ndarray:
        folded = self.next(width, count)
        return np.cumsum(np.where(folded % 2, -(folded + 1) // 2, folded // 2))


class Reader:
    """A scene read by the rules of docs/static.md."""

    def __init__(self, folder: Path) -> None:
        self.scene = json.loads((folder / "scene.json").read_bytes())
        self.data: dict[str, list[bytes]] = {}
        for kind, file in self.scene["files"].items():
            alone = file["name"].endswith(".bin")
            names = [file["name"] if alone else f"{file['name']}-{k}.bin" for k in range(file["count"])]
            self.data[kind] = found = [(folder / name).read_bytes() for name in names]
            assert sum(map(len, found)) == file["bytes"]
            hashes = [hashlib.sha256(data) for data in found]
            whole = hashes[0] if alone else hashlib.sha256(b"".join(h.digest() for h in hashes))
            assert file["name"].removesuffix(".bin") == f"{kind}-{whole.hexdigest()[:16]}"
        columns = Columns(self.data["index"][0], self.scene["parts"])
        places = np.stack([columns.sums(3) for _ in range(3)], axis=1)
        said = self.scene["places"]
        self.centers = np.array(said["middle"]) + said["scale"] * np.sinh(places / 64)
        self.radii = said["scale"] * 2.0 ** ((columns.next(1) - 128) / 4)
        self.counts = columns.next(4)
        self.is_plain = "plain" in self.data
        parts = self.data["plain" if self.is_plain else "part"]
        assert columns.next(4).tolist() == [len(data) for data in parts]
        assert columns.next(4).tolist() == [len(data) for data in self.data.get("terms", [b""] * len(self.counts))]
        assert columns.at == len(columns.data)
        self.chunks: dict[int, tuple[Any, ...]] = {}  # rows by the first id
        if self.is_plain:
            self.pieces = [self.plain(data) for data in parts]
            self.sets = np.concatenate([piece["sets"] for piece in self.pieces])
        else:
            self.sets = self.read_sets()
            self.pieces = [self.piece(data) for data in parts]

    @cached_property
    def coding(self) -> Coding:
        """The code of the records."""
        said = parse_object("scene.json", json.dumps(self.scene["colors"]).encode())
        grids = grids_of(said, self.scene["colors"]["variant"])
        return Coding(grids, None, Tables.from_text(self.scene["code"], table_sizes(grids)))

    def plain(self, data: bytes) -> dict[str, Any]:
        """What a part holds that is not coded."""
        first, g, c, width = struct.unpack_from("<4I", data)
        assert len(data) == 16 + 36 * c + (16 + width) * g
        floats = np.frombuffer(data, "<f4", 8 * c, 16).reshape(c, 8)
        sizes = np.frombuffer(data, "<u4", c, 16 + 32 * c)
        of = np.repeat(np.arange(c, dtype=np.int32), sizes & 0xFFFF)
        bits = unpack_bits(sizes >> 16, 14)
        table = table_of([(row[:3], row[4:7], int(row[3]), int(row[7]), bits[k]) for k, row in enumerate(floats)])
        records = np.frombuffer(data, np.uint8, 16 * g, 16 + 36 * c).reshape(g, 16)
        sets = np.frombuffer(data, np.uint8, width * g, 16 + 36 * c + 16 * g).reshape(g, width) ^ 128
        said = self.scene["harmonics"]
        used = 0 if said is None else 3 * ((said["degree"] + 1) ** 2 - 1)
        assert (sets[:, used:] == 128).all()
        assert width == -(-used // 16) * 16
        layout = RecordLayout.from_variant(self.scene["colors"]["variant"])
        ids = first + np.arange(g)
        means = decode_records(records, table, layout, chunks=of).means
        return {"ids": ids, "records": records, "means": means, "labels": ids, "sets": sets[:, :used]}

    def piece(self, data: bytes) -> dict[str, Any]:
        """What a piece holds; the rows of its chunks are kept."""
        head, g, c, m, records, terms = struct.unpack_from("<6I", data)
        assert len(data) == 24 + head + records + terms
        columns = Columns(data[24 : 24 + head], c)
        starts, counts = columns.sums(4), columns.next(1) + 1
        floats = np.stack([columns.next(4) for _ in range(6)], axis=1).astype(np.uint32).view(np.float32)
        lows, bits, strides = columns.next(2) - (1 << 15), columns.next(2), columns.next(1)
        for k, start in enumerate(starts.tolist()):
            row = floats[k, :3], floats[k, 3:], int(lows[k]), int(strides[k]), unpack_bits(bits[k : k + 1], 14)[0]
            if strides[k]:
                assert all(np.array_equal(a, b) for a, b in zip(row, self.chunks.setdefault(start, row), strict=True))
        ends = np.cumsum(counts)
        skips = columns.next(1, g)
        within = np.cumsum(skips + 1) - 1
        first = np.repeat(np.concatenate([[0], within[ends[:-1] - 1] + 1]) if c else np.zeros(0, int), counts)
        ids = np.repeat(starts, counts) + within - first
        owners, over = columns.sums(4, m), columns.next(1, m)
        numbers = over.copy()
        for k in range(1, m):
            numbers[k] += numbers[k - 1] + 1 if owners[k] == owners[k - 1] else 0
        labels = columns.next(label_bytes(len(self.sets)), g) if len(self.sets) else np.zeros(g, int)
        assert columns.at == len(columns.data)
        rows = [self.chunks[start] for start in starts.tolist()]
        of = np.repeat(np.arange(c, dtype=np.int32), counts)
        table = table_of(rows)
        at = 24 + head
        found = self.coding.decode_records(np.frombuffer(data[at : at + records], np.uint8), ids, of, chunks_of(table))
        coded = self.coding.decode_terms(np.frombuffer(data[at + records :], np.uint8), owners)
        assert found is not None
        assert coded is not None
        geometry = decode_records(found, table, RecordLayout.from_variant(self.scene["colors"]["variant"]), chunks=of)
        return {
            "ids": ids, "records": found, "means": geometry.means, "owners": owners, "numbers": numbers,
            "terms": coded, "labels": labels,
        }  # fmt: skip

    def read_sets(self) -> np.ndarray:
        """The sets of harmonics, each with the bytes of all coefficients."""
        said = self.scene["harmonics"]
        if said is None:
            return np.zeros((0, 0), np.uint8)
        width = 3 * ((said["degree"] + 1) ** 2 - 1)
        apart = [np.frombuffer(zlib.decompress(data), np.uint8).reshape(width, -1).T for data in self.data["sets"]]
        blocks = [(128 + np.cumsum(each, axis=0, dtype=int)).astype(np.uint8) for each in apart]
        assert [len(data) for data in self.data["sets"]] == said["bytes"]
        assert all(len(block) == 1024 for block in blocks[:-1])
        found = np.concatenate(blocks)
        assert len(found) == said["sets"]
        assert len(blocks) == len(said["worth"])
        return found

    def harmonics(self) -> np.ndarray:
        """(N, 3 K) the harmonics of all Gaussians."""
        found: np.ndarray = self.sets[self.by_id("labels")]
        return found

    def by_id(self, key: str) -> np.ndarray:
        """Records, means or labels of all Gaussians."""
        found = np.concatenate([piece[key] for piece in self.pieces])
        out = np.empty_like(found)
        out[np.concatenate([piece["ids"] for piece in self.pieces])] = found
        return out

    @property
    def ids(self) -> np.ndarray:
        return np.concatenate([piece["ids"] for piece in self.pieces])

    def terms(self) -> list[list[bytes]]:
        """Records of terms by id, in their order."""
        out: list[list[bytes]] = [[] for _ in range(self.scene["gaussians"])]
        for data in self.data.get("terms", []):
            piece = self.piece(data)
            for owner, number, row in zip(piece["owners"], piece["numbers"], piece["terms"], strict=True):
                assert number == len(out[owner])
                out[owner].append(row.tobytes())
        return out

    def cells(self) -> list[tuple[np.ndarray, np.ndarray | None]]:
        """Gains (P,) of parts in each cell, and what their terms are worth; `spheres` are those of the same cells.

        A sphere (P, 4) is a center and a radius, scene units.
        """
        columns = Columns(self.data["grid"][0], self.scene["cells"]["count"])
        self.boxes = np.stack([columns.sums(4) for _ in range(3)], axis=1)
        self.spheres: list[np.ndarray] = []
        self.looks: list[int] = []  # bytes of glances
        glances = self.scene["cells"]["glances"]
        assert columns.next(4).tolist() == [len(row) for row in self.data["row"]]
        out = []
        parts = self.scene["parts"]
        bits = -(-parts // 8)
        for coded in self.data["row"]:
            data = np.frombuffer(zlib.decompress(coded), np.uint8)
            seen = np.flatnonzero(np.unpackbits(data[:bits], bitorder="little"))
            gains = np.zeros(parts)
            gains[seen] = 2.0 ** ((data[bits : bits + len(seen)] - 255.0 + self.scene["cells"]["gain_top"]) / 4)
            rest, worth = data[bits + len(seen) :], None
            if glances is not None:
                planes = rest[len(rest) - 4 * glances["sectors"] :].reshape(4, -1).astype(np.int64)
                self.looks += (planes << 8 * np.arange(4)[:, None]).sum(axis=0).tolist()
                rest = rest[: len(rest) - planes.size]
            if self.scene["cells"]["active"]:
                worth = np.zeros(parts)
                worth[seen] = np.where(rest[: len(seen)] > 0, 2.0 ** (rest[: len(seen)] - 128.0), 0.0)
                rest = rest[len(seen) :]
            spheres = np.column_stack([self.centers, self.radii])
            if self.scene["cells"]["spheres"]:
                steps = rest.reshape(4, -1).T - 128.0
                spheres[seen, :3] += steps[:, :3] / 32 * self.radii[seen, None]
                spheres[seen, 3] *= 2.0 ** (steps[:, 3] / 4)
            else:
                assert len(rest) == 0
            self.spheres.append(spheres)
            out.append((gains, worth))
        assert self.looks == [len(data) for data in self.data.get("glance", [])]
        return out


def table_of(rows: list[tuple[Any, ...]]) -> ChunkTable:
    if not rows:
        return ChunkTable.concatenate([])
    origins, steps, lows, strides, bits = (np.array(column) for column in zip(*rows, strict=True))
    counts = np.full(len(rows), 256, np.uint16)
    return ChunkTable(origins, steps, lows.astype(np.int16), strides.astype(np.uint8), counts, bits)


def matched(read: Reader, package: Package) -> np.ndarray:
    """Id in the package of each id of its static form, by records and means; all are of the highest level."""
    contents = package.contents
    means = contents.gaussians().means
    found = {
        (row.tobytes(), mean.tobytes()): k for k, (row, mean) in enumerate(zip(contents.records, means, strict=True))
    }
    pairs = zip(read.by_id("records"), read.by_id("means"), strict=True)
    return np.array([found[row.tobytes(), mean.tobytes()] for row, mean in pairs])


@pytest.fixture
def package(tmp_path: Path) -> Iterator[Package]:
    with package_of(tmp_path / "s.gsvis", 700) as made:
        yield made


def test_a_package_reads_back_record_by_record(package: Package, tmp_path: Path) -> None:
    made = write_static(tmp_path / "out", package, StaticOptions(name="two rooms"))
    read, contents = Reader(tmp_path / "out"), package.contents
    highest = np.flatnonzero(contents.last == len(contents.names) - 1)
    assert sorted(read.ids) == list(range(len(highest)))
    ids = matched(read, package)
    assert sorted(ids) == highest.tolist()
    assert (np.diff(contents.chunks[ids]) >= 0).all()
    offsets, terms = contents.term_offsets, read.terms()
    for k, i in enumerate(ids):
        assert terms[k] == [row.tobytes() for row in contents.term_records[offsets[i] : offsets[i + 1]]]
    assert (read.scene["name"], read.scene["up"]) == ("two rooms", [0, -1, 0])
    assert made.nbytes == sum(len(data) for found in read.data.values() for data in found)
    assert (made.gaussians, made.terms, made.parts) == (len(highest), sum(map(len, terms)), len(read.counts))


def test_the_sphere_of_a_part_is_where_its_light_is(package: Package, tmp_path: Path) -> None:
    write_static(tmp_path / "out", package)
    read, g = Reader(tmp_path / "out"), package.contents.gaussians()
    of, bright = matched(read, package), Lights(package, package.contents.gaussians()).brightest()
    for center, radius, piece in zip(read.centers, read.radii, read.pieces, strict=True):
        ids = of[piece["ids"]]
        if not bright[ids].any():
            continue
        away = np.average(np.square(g.means[ids] - center).sum(axis=1), weights=bright[ids]) ** 0.5
        assert away / 2 ** (0.51 / 4) <= radius <= away * 2 ** (0.51 / 4)
        mean = np.average(g.means[ids], axis=0, weights=bright[ids])
        assert (
            np.linalg.norm(mean - center)
            <= 0.1 * np.linalg.norm(center - read.scene["places"]["middle"]) + 0.1 * radius
        )


def test_a_cell_says_what_each_part_and_its_terms_are_worth(package: Package, tmp_path: Path) -> None:
    write_static(tmp_path / "out", package)
    read, g, sets = Reader(tmp_path / "out"), package.contents.gaussians(), package.visibility
    of, contents, active = matched(read, package), package.contents, package.active_terms
    owners = np.repeat(np.arange(len(g)), contents.term_counts)
    lights = Lights(package, g)
    highest = contents.last == len(contents.names) - 1
    for cell, (gains, worth) in enumerate(read.cells()):
        light = np.zeros(len(g))
        ids, values = lights.drawn_in(cell, highest).light
        light[ids] = values
        changes = contributions(contents.colors().dequantize(), g.means, sets.grid.centers[cell])
        squares = np.zeros(len(owners))
        some = active.active_ids(cell)
        squares[some] = np.maximum(changes[some], active.epsilon) ** 2
        assert worth is not None
        for k, piece in enumerate(read.pieces):
            members = of[piece["ids"]]
            mine = np.isin(owners, members)
            assert gains[k] == pytest.approx(light[members].sum(), rel=0.1)
            wanted = squares[mine] @ light[owners[mine]]
            assert 0.7 * wanted <= worth[k] <= 1.42 * wanted


def test_a_cell_says_where_the_light_of_a_part_is_that_its_pictures_show(
    package: Package, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gsvis.export.parts.PART", 40)
    write_static(tmp_path / "out", package)
    read, g = Reader(tmp_path / "out"), package.contents.gaussians()
    of, lights = matched(read, package), Lights(package, package.contents.gaussians())
    highest = package.contents.last == len(package.contents.names) - 1
    read.cells()
    own = np.column_stack([read.centers, read.radii])
    shown_parts = 0
    for cell, spheres in enumerate(read.spheres):
        (ids, _), drawn, *_ = lights.drawn_in(cell, highest)
        light = np.zeros(len(g))
        light[ids] = drawn
        for sphere, part, piece in zip(spheres, own, read.pieces, strict=True):
            members = of[piece["ids"]]
            if not light[members].any():
                np.testing.assert_array_equal(sphere, part)
                continue
            shown_parts += 1
            middle = np.average(g.means[members].astype(float), axis=0, weights=light[members])
            steps = (middle - part[:3]) / part[3]
            near = np.abs(steps) < 3.9
            np.testing.assert_allclose(sphere[:3][near], middle[near], atol=0.51 / 32 * part[3])
            away = np.average(np.square(g.means[members] - middle).sum(axis=1), weights=light[members])
            least = 0.035 * lights.grid.cell_size
            assert abs(np.log2(sphere[3] / np.sqrt(away + least**2))) < 0.13
    assert shown_parts > len(read.spheres)


def test_pictures_in_a_cell_add_to_what_its_classes_tell(package: Package) -> None:
    contents = package.contents
    highest = contents.last == len(contents.names) - 1
    lights = Lights(package, contents.gaussians())
    for cell in range(len(lights)):
        ids, stated = lights.of_cell(cell)
        (_, drawn), added, *_ = lights.drawn_in(cell, highest)
        (_, without), nothing, *_ = lights.drawn_in(cell, np.zeros(len(highest), np.bool_))
        assert not nothing.any()
        assert np.array_equal(drawn[~highest[ids]], without[~highest[ids]])  # other levels are not drawn
        np.testing.assert_allclose(drawn, without + added)
        assert (added >= 0.0).all()
        assert 0.0 < added.sum() <= 24.0  # six faces of four, were every pixel opaque
        assert np.allclose(without / without.sum(), stated / stated.sum())


def test_the_file_of_a_first_view_has_most_of_its_light_without_any_other_file(
    package: Package, tmp_path: Path
) -> None:
    eye = package.visibility.grid.centers[3]
    lights = Lights(package, package.contents.gaussians())
    seen, light = lights.of_eye(eye)
    brightest = package.contents.gaussians().means[seen[light.argmax()]]
    start = replace(Start.looking(eye, brightest, (0.0, -1.0, 0.0)), mode="orbit")
    write_static(tmp_path / "out", package, StaticOptions(poses=(start,)))
    read = Reader(tmp_path / "out")
    of, counts = matched(read, package), package.contents.term_counts
    (data,) = read.data["first"]
    assert read.scene["first"] == [{"bytes": len(data), **start.as_dict()}]
    (size,) = struct.unpack_from("<I", data)
    left = np.frombuffer(zlib.decompress(data[4 : 4 + size]), np.uint8) / 255
    read.chunks.clear()
    ids: list[int] = []
    terms: list[tuple[int, int]] = []
    at = 4 + size
    while at < len(data):
        head, _, _, _, records, coded = struct.unpack_from("<6I", data, at)
        piece = read.piece(data[at : at + 24 + head + records + coded])
        ids += piece["ids"].tolist()
        assert set(piece["owners"].tolist()) <= set(ids)
        terms += zip(piece["owners"].tolist(), piece["numbers"].tolist(), strict=True)
        at += 24 + head + records + coded
    assert len(set(ids)) == len(ids) > 0
    assert len(set(terms)) == len(terms) > 0
    assert all(number < counts[of[owner]] for owner, number in terms)
    here = np.isin(seen, of[ids])
    for share, piece in zip(left, read.pieces, strict=True):
        mine = np.isin(seen, of[piece["ids"]])
        wanted = light[mine & ~here].sum() / light[mine].sum() if mine.any() else 1.0
        assert abs(share - wanted) < 0.003


def test_a_first_view_begins_with_what_its_picture_shows_most(package: Package, tmp_path: Path) -> None:
    g = package.contents.gaussians()
    highest = np.flatnonzero(package.contents.last == len(package.contents.names) - 1)
    eye = package.visibility.grid.centers[3]
    start = Start.looking(eye, g.means[highest].mean(axis=0), (0.0, -1.0, 0.0))
    write_static(tmp_path / "out", package, StaticOptions(poses=(start,)))
    read = Reader(tmp_path / "out")
    of = matched(read, package)
    (data,) = read.data["first"]
    at = 4 + struct.unpack_from("<I", data)[0]
    head, _, _, _, records, coded = struct.unpack_from("<6I", data, at)
    first = of[read.piece(data[at : at + 24 + head + records + coded])["ids"]]
    rest = np.setdiff1d(highest, first)
    rotation = rotations_from_quats(np.array([start.rotation]))[0].T
    viewmat = np.eye(4)
    viewmat[:3, :3] = rotation
    viewmat[:3, 3] = -rotation @ eye
    camera = Cameras(viewmat[None], [[[278.0, 0.0, 320.0], [0.0, 278.0, 180.0], [0.0, 0.0, 1.0]]], 640, 360)
    weights = np.zeros(len(g))
    weights[highest] = view_weights(g[highest], camera).summed[0]
    assert len(rest) > 0
    assert weights[first].sum() > 0
    assert np.median(weights[first]) >= weights[rest].max()


def test_first_views_of_a_small_scene_are_cut_only_where_their_bytes_count(
    package: Package, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gsvis.export.first._PIECE", (40, 40))
    g = package.contents.gaussians()
    eye = package.visibility.grid.centers[3]
    start = Start.looking(eye, g.means.mean(axis=0), (0.0, -1.0, 0.0))
    poses = (start,) * 8
    write_static(tmp_path / "cut", package, StaticOptions(poses=poses, most_first=0))
    write_static(tmp_path / "whole", package, StaticOptions(poses=poses))
    cut, whole = Reader(tmp_path / "cut").data, Reader(tmp_path / "whole").data
    assert len(whole["first"][0]) > 1.5 * len(cut["first"][0])
    assert len(cut["first"][0]) < sum(map(len, cut["part"]))
    assert whole["part"] == cut["part"]


def test_parts_are_boxes_in_space_with_the_brightest_gaussians_first() -> None:
    rng = np.random.default_rng(2)
    means, gains = rng.uniform(0, 1, (4000, 3)) * [8, 2, 1], rng.uniform(size=4000)
    parts = divide_in_space(means, gains, 125)
    assert sorted(np.concatenate(parts).tolist()) == list(range(4000))
    assert {len(part) for part in parts} == {125}
    assert all((np.diff(part) > 0).all() for part in parts)
    for bright, dim in zip(parts[::2], parts[1::2], strict=True):
        assert gains[bright].min() >= gains[dim].max()
        box = np.ptp(means[np.concatenate([bright, dim])], axis=0)
        assert box.max() <= 2.2
    assert divide_in_space(means[:0], gains[:0]) == []
    assert [part.tolist() for part in divide_in_space(means[:1], gains[:1])] == [[0]]


@pytest.mark.parametrize("alone", [None, 1000, 100])
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_a_bare_scene_reads_back_as_what_it_was(
    degree: int, alone: int | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gsvis.export.near._ALONE", alone)
    g = random_scene(np.random.default_rng(1), 900, sh_degree=degree)
    made = write_static(tmp_path, g, StaticOptions(is_near=alone is not None))
    read = Reader(tmp_path)
    assert (made.cells, made.sh_degree, len(read.cells())) == (1, degree, 1)
    assert [level["count"] for level in read.scene["levels"]] == [900]
    assert (read.cells()[0][0] > 0).all()
    records = read.by_id("records")
    apart = np.linalg.norm(read.by_id("means")[:, None] - g.means[None], axis=2)
    pairs = apart.argmin(axis=1)
    assert sorted(pairs.tolist()) == list(range(900))
    assert np.allclose(records[:, 0] / 255, g.opacities[pairs], atol=0.5 / 255 + 1e-6)
    from gsvis.color.records import PRECISIONS, Grids

    said = read.scene["colors"]
    red, green, blue = (tuple(pair) for pair in said["base"])
    base = red, green, blue
    grids = Grids("rgb", PRECISIONS["wire"], base, (1.0, 1.0), (1.0, 1.0), 0.0)
    rgb = np.stack([grids.base_table(k)[records[:, 1 + k]] for k in range(3)], axis=1)
    span = max(high - low for low, high in base)
    assert np.abs(rgb - (0.5 + SH_C0 * g.sh0[pairs, 0])).max() < 0.02 * span
    if degree == 0:
        assert read.scene["harmonics"] is None
        return
    count = (degree + 1) ** 2 - 1
    by_id = read.harmonics()
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
    back = made.decode(made.encode(values))
    assert np.abs(back[:, 1]).max() < 1e-12
    assert made.high[0] < 100.0
    assert np.abs(back[1:, 2] - np.clip(values[1:, 2], made.low[2], made.high[2])).max() < made.high[2] / 250


def test_of_levels_the_highest_one_is_written(tmp_path: Path) -> None:
    levels = levels_of(500)
    write_static(tmp_path, levels)
    read = Reader(tmp_path)
    top = levels.level(len(levels) - 1)
    assert [(each["name"], each["count"]) for each in read.scene["levels"]] == [(levels.names[-1], len(top))]
    assert np.allclose(np.sort(read.by_id("means"), axis=0), np.sort(top.means, axis=0), atol=1e-2)


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
    damaged = next(p for p in (tmp_path / "a").iterdir() if p.name.startswith("part"))
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
    assert Reader(tmp_path / "a").cells()[0][1] is None
    with package_of(tmp_path / "h.gsvis", 300, "hsl") as hsl:
        write_static(tmp_path / "b", hsl)
        read = Reader(tmp_path / "b")
        assert len(set(matched(read, hsl).tolist())) == len(read.ids)
    assert read.scene["colors"]["variant"] == "hsl"


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
