"""A world of any size from one package: copies of it, moved, side by side on a lattice, each a tile of its own.

The packages of moved tiles share the files of their records by hard links; their tables of chunks and their visible
sets, which hold places, are files of their own. The tables of the first columns of the lattice are computed as a server
does. In the rest of the file of tables are holes, which take no disk: a server must not read there before somebody
comes near.
"""

from __future__ import annotations

import base64
import os
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from gsvis.files.limits import digest_of
from gsvis.files.mapped import MappedArrays, _write_head, _write_sums
from gsvis.files.sections import SectionFile, SectionWriter
from gsvis.package import Package
from gsvis.package.blocks import write_blocks
from gsvis.package.codec import lay_linear
from gsvis.package.manifest import MANIFEST, Blob
from gsvis.package.package import PARTS, columns_of
from gsvis.package.parts import PartFolder
from gsvis.progress import silent
from gsvis.pvs._writer import FILE_KIND
from gsvis.pvs.codec import word_count
from gsvis.stream.header import SceneHeader, identity_of
from gsvis.stream.kept import _key
from gsvis.world.manifest import Grid, WorldManifest
from gsvis.world.streamed import WorldSource, open_world
from gsvis.world.world import tile_of_package

PIXEL = 2e-3
_PAGE = 1 << 12


def linear(package: Path, to: Path) -> Path:
    """Write a package with all centers in boxes of chunks; those on a lattice of logarithms cannot be moved."""
    if (to / MANIFEST).is_file():
        return to
    with Package.open(package) as found:
        m, contents, parts = found.manifest, found.contents, PartFolder(to / PARTS)
        records, table = lay_linear(contents.records, contents.table, contents.layout)
        (to / PARTS).mkdir(parents=True)
        blocks = tuple(write_blocks(parts, replace(contents, records=records, table=table), silent))
        tables = ((parts.write_columns("chunks", columns_of(table, contents.chunk_levels)), len(table)),)
        for blob in (m.visibility, m.active_terms):
            for part in () if blob is None else blob.parts:
                os.link(package / PARTS / part.name, to / PARTS / part.name)
        (to / MANIFEST).write_bytes(replace(m, tables=tables, blocks=blocks).to_json())
    return to


def lattice(package: Path, to: Path, columns: int, rows: int) -> Path:
    """Write a world of columns times rows copies of a package with cells, moved; the cells of neighbors touch.

    All centers of the package are in boxes of chunks, see `linear`.
    """
    if (to / "world.json").is_file():
        return to
    (to / "packages").mkdir(parents=True, exist_ok=True)
    with Package.open(package) as small:
        assert not small.contents.table.logarithmic.any(), "centers that cannot be moved"
        grid, up = small.visibility.grid, small.manifest.info.up
        meters, count = small.manifest.info.meters_per_unit, len(grid)
        x, y = (k for k in range(3) if up[k] == 0.0)
        width, height = int(grid.shape[x]), int(grid.shape[y])
        side, tiles = float(grid.cell_size), []
        for copy in range(columns * rows):
            place = np.array(divmod(copy, rows)) * (width, height)
            by = np.zeros(3)
            by[[x, y]] = side * place
            folder = moved(small, to / "packages", by, str(copy))
            low = grid.origin + by
            with Package.open(folder) as found:
                tiles.append(
                    tile_of_package(
                        folder, found.manifest, coords=tuple(place.tolist()), shape=(width, height), cells=count,
                        low=tuple(low.tolist()), high=tuple((low + side * np.array(grid.shape)).tolist()),
                    )
                )  # fmt: skip
    squares = Grid(tuple(grid.origin.tolist()), side, (x, y), (width * columns, height * rows))
    WorldManifest(up, meters, squares, tuple(tiles)).write(to / "world.json")
    return to


def moved(found: Package, packages: Path, by: np.ndarray, note: str) -> Path:
    """Write a package whose Gaussians and cells are moved, under the name of its content."""
    work = packages / f".{note}"
    shutil.rmtree(work, ignore_errors=True)
    (work / PARTS).mkdir(parents=True)
    m, contents, parts = found.manifest, found.contents, PartFolder(work / PARTS)
    tables, sets = m.tables, m.visibility
    kept = {part.name for block in m.blocks for part in (block.gaussians, *(part for part, _ in block.terms))}
    if by.any():
        table = replace(contents.table, origins=(contents.table.origins + by).astype(np.float32))
        tables = ((parts.write_columns("chunks", columns_of(table, contents.chunk_levels)), len(table)),)
    else:
        kept |= {part.name for part, _ in m.tables}
    if sets is not None:
        _move_store(found.visibility.path, work / "sets.pvs", by)
        part = parts.write_bytes((work / "sets.pvs").read_bytes())
        sets = Blob((part,), part.nbytes)
        (work / "sets.pvs").unlink()
    for name in kept:
        os.link(found.path / PARTS / name, work / PARTS / name)
    info = replace(m.info, provenance={"copy": note})
    (work / MANIFEST).write_bytes(replace(m, info=info, tables=tables, visibility=sets).to_json())
    to = packages / digest_of(work / MANIFEST)
    shutil.rmtree(to, ignore_errors=True)
    work.rename(to)
    return to


def _move_store(store: Path, to: Path, by: np.ndarray) -> None:
    file = SectionFile(store, FILE_KIND)
    header: dict[str, Any] = {k: v for k, v in file.header.value.items() if k != "sections"}
    header["grid"] = {**header["grid"], "origin": np.add(header["grid"]["origin"], by).tolist()}
    with to.open("w+b") as out:
        writer = SectionWriter(out, FILE_KIND)
        for name in file.sections:
            writer.append(file.read(name))
            writer.close_section(name)
        writer.finish(header)
    file.close()


def write_tables(world: Path, part: Path, folder: Path) -> None:
    """Write the file of tables of a world whose first nodes are those of another one; the rest of it are holes."""
    whole = WorldSource.open(world)
    path = folder / f"{_key(whole, PIXEL, None)}.tables"
    if path.is_file():
        return
    _, kept = open_world(part, tables=folder, quality=None)
    assert kept is not None
    own = WorldSource.open(part)
    known = MappedArrays(folder / f"{_key(own, PIXEL, None)}.tables")
    about = SceneHeader.parse(base64.b64decode(known.facts["welcome"]))
    assert about.grids == whole.manifest.grids
    n, small = whole.manifest.gaussians, own.manifest.gaussians
    cells, box, weights = whole.cell_arrays()
    cells["class_weights"] = weights
    lengths = {
        small: n, small + 1: n + 1, word_count(small): word_count(n), 64 * word_count(small): 64 * word_count(n),
        -(-small // 64): -(-n // 64), -(-small // 64) + 1: -(-n // 64) + 1,
    }  # fmt: skip
    rows, blocks, end, places = [], [], 0, dict[tuple[int, str], tuple[int, list[int]]]()
    for name, array in known.arrays.items():
        given = cells.get(name)
        if given is not None:
            array, shape = given, list(given.shape)
        else:
            axis = 1 if name in ("bodies", "all_places") else 0
            count = array.shape[axis]
            more = lengths.get(count, -(-count * n // small) if count > 64 else count)
            shape = [*array.shape[:axis], more, *array.shape[axis + 1 :]]
        key = array.ctypes.data if array.size else id(array), array.dtype.str
        if key not in places:
            places[key] = end, shape
            blocks.append((end, array, shape))
            end += -(-array.itemsize * int(np.prod(shape)) // _PAGE) * _PAGE
        place, shape = places[key]
        rows.append([name, array.dtype.str, shape, place, bool(known.arrays[name].flags.writeable)])
    header = SceneHeader.from_manifest(whole.manifest, about.coding)
    facts = {
        **known.facts, "welcome": base64.b64encode(header.to_message()).decode(), "box": box,
        "level_counts": list(whole.manifest.counts), "identity": identity_of(whole.manifest, None),
    }  # fmt: skip
    with path.with_suffix(".partial").open("w+b") as out:
        _write_head(out, facts, rows, end)
        start = out.tell()
        out.truncate(start + end)
        for place, array, shape in blocks:
            lines = array if array.ndim == 2 and array.shape[1] != shape[1] else array[None]
            size = array.itemsize * int(np.prod(shape)) // len(lines)
            for k, line in enumerate(lines):
                out.seek(start + place + k * size)
                out.write(np.ascontiguousarray(line).reshape(-1).view(np.uint8).data)
        _write_sums(out, end)
    path.with_suffix(".partial").rename(path)
    known.path.unlink()
