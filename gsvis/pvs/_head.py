"""Read the parts of a store that opening needs: its header, the rows of its cells, and their certificates."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsvis.errors import FormatError, SceneError
from gsvis.files.limits import DAMAGED, Budget
from gsvis.files.sections import SectionFile
from gsvis.pvs._order import MAX_DEPTH
from gsvis.pvs._writer import CELL_ROW, FORMAT, FORMAT_RUNS, FORMAT_SHARED, StoreInfo, beyond_free
from gsvis.pvs.cells import MAX_CELLS, CellGrid
from gsvis.pvs.codec import CodecError, decompress
from gsvis.pvs.stored_certificates import CERTIFIED_ROW, StoredCertificates

__all__ = ["read_certificates", "read_header", "read_rows", "read_runs"]

_MOST_RUN = 1 << 16  # neighbors that may share a direction set, or a shift of their classes


def read_header(file: SectionFile) -> tuple[StoreInfo, CellGrid]:
    """Return the facts of the build of a store, and its cells.

    Raises:
        FormatError: If the header is damaged.
    """
    header = file.header
    if header.raw("format") not in (FORMAT, FORMAT_SHARED, FORMAT_RUNS):
        raise _fault(file, "format", repr(FORMAT), repr(header.raw("format"))[:60])
    scene = header.raw("scene")
    grid = header.child("grid")
    if not isinstance(scene, str):
        raise _fault(file, "scene", "the hash of a scene", repr(scene)[:60])
    n = header.integer("gaussians", 0, (1 << 31) - 1)
    cells = grid.integer("cells", 1, MAX_CELLS)
    Budget(file.path, file.size).claim(beyond_free(n) + 12 * cells, "header")
    config = header.child("config").value
    x, y, z = (int(side) for side in grid.numbers("shape", 3))
    origin = grid.numbers("origin", 3)
    size = grid.number("cell_size")
    up = grid.numbers("up", 3)
    tau = header.number("tau")
    edges = header.numbers("class_edges")
    try:
        boxes = decompress(file.read("coords"), 12 * cells)
    except CodecError as error:
        raise _fault(file, "section 'coords'", "bytes that can be decoded", f"damaged ones ({error})") from error
    coords = np.frombuffer(boxes, "<i4").reshape(-1, 3).astype(np.int32)
    try:
        return StoreInfo(n, scene, tau, edges, config), CellGrid(origin, size, (x, y, z), coords, up)
    except (ValueError, SceneError) as error:
        raise _fault(file, "header", "a grid and classes that are valid", str(error)) from error


def read_runs(file: SectionFile) -> tuple[int, int]:
    """Return the number of neighbors that share a direction set, and of those that share a shift of their classes.

    In the first format they are 1 and 0: each Gaussian has a direction set, and a class from each cell. Classes are
    shared in the third format alone.

    Raises:
        FormatError: If the header is damaged.
    """
    if file.header.raw("format") == FORMAT:
        return 1, 0
    directions = file.header.integer("directions_run", 1, _MOST_RUN)
    if file.header.raw("format") == FORMAT_SHARED:
        return directions, 0
    return directions, file.header.integer("classes_run", 1, _MOST_RUN)


def read_rows(file: SectionFile, cells: int, gaussians: int) -> NDArray[Any]:
    """Return the rows of a store with that many cells and Gaussians.

    Raises:
        FormatError: If they do not fit the file, or each other.
    """
    data = file.read("cells")
    if len(data) != cells * CELL_ROW.itemsize:
        raise _fault(file, "section 'cells'", f"{cells} rows", f"{len(data)} bytes")
    rows = np.frombuffer(data, CELL_ROW)
    for kind, name in (("set", "sets"), ("class", "classes")):
        lengths = rows[f"{kind}_length"].astype(np.int64)
        starts = np.cumsum(lengths) - lengths
        size = file.section(name).length
        offsets = rows[f"{kind}_offset"].astype(np.int64)
        if int(lengths.sum()) != size:
            got = f"{int(lengths.sum()):,}"
            raise _fault(file, "section 'cells'", f"cells of {size:,} bytes, the size of section {name!r}", got)
        if not np.array_equal(offsets, starts):
            k = int(np.argmax(offsets != starts))
            raise _fault(
                file, "section 'cells'", f"cell {k} at byte {starts[k]:,} of section {name!r}", f"{offsets[k]:,}"
            )
    at = np.arange(len(rows))
    for _ in range(MAX_DEPTH + 1):  # every valid chain of parents ends within these steps
        parents = rows["parent"][at].astype(np.int64)
        if len(at) and (parents.min() < -1 or parents.max() >= len(rows)):
            worst = parents.min() if parents.min() < -1 else parents.max()
            raise _fault(file, "section 'cells'", f"parents from -1 to {len(rows) - 1}", f"{worst}")
        at = parents[parents >= 0]
    if len(at):
        raise _fault(file, "section 'cells'", f"chains of at most {MAX_DEPTH} parents", "a longer one, or a circle")
    if len(rows) and rows["visible"].max() > gaussians:
        got = f"{int(rows['visible'].max()):,}"
        raise _fault(file, "section 'cells'", f"sets of at most {gaussians:,} Gaussians", got)
    return rows


def read_certificates(file: SectionFile, cells: int) -> StoredCertificates:
    """Return the certificates of a store with that many cells.

    Raises:
        FormatError: If they do not fit the cells, or are damaged.
    """
    if "certificates" not in file.sections:  # stores of older versions
        return StoredCertificates.none(cells)
    data = file.read("certificates")
    if len(data) != cells * CERTIFIED_ROW.itemsize:
        raise _fault(file, "section 'certificates'", f"{cells} rows", f"{len(data)} bytes")
    try:
        return StoredCertificates.from_rows(np.frombuffer(data, CERTIFIED_ROW))
    except ValueError as error:
        raise _fault(file, "section 'certificates'", "valid rows", str(error)) from error


def _fault(file: SectionFile, where: str, expected: str, got: str) -> FormatError:
    return FormatError(file.path, where, expected, got, DAMAGED)
