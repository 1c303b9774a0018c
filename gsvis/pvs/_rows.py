"""The rows of the cells of a store: where the set and the classes of each lie, and which cell is its parent."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsvis.errors import FormatError
from gsvis.files.limits import DAMAGED
from gsvis.files.sections import SectionFile
from gsvis.pvs._order import MAX_DEPTH
from gsvis.pvs._writer import CELL_ROW

__all__ = ["read_rows"]


def read_rows(file: SectionFile, cells: int, gaussians: int) -> NDArray[Any]:
    """Return the rows of a store with so many cells and Gaussians.

    Raises:
        FormatError: If they do not fit the file, or each other.
    """

    def fault(where: str, expected: str, got: str) -> FormatError:
        return FormatError(file.path, where, expected, got, DAMAGED)

    data = file.read("cells")
    if len(data) != cells * CELL_ROW.itemsize:
        raise fault("section 'cells'", f"{cells} rows", f"{len(data)} bytes")
    rows = np.frombuffer(data, CELL_ROW)
    for kind, name in (("set", "sets"), ("class", "classes")):
        lengths = rows[f"{kind}_length"].astype(np.int64)
        starts = np.cumsum(lengths) - lengths
        whole = int(lengths.sum()) == file.section(name).length
        if not whole or not np.array_equal(rows[f"{kind}_offset"].astype(np.int64), starts):
            raise fault("section 'cells'", f"cells that fill section {name!r} in order", "others")
    at = np.arange(len(rows))
    for _ in range(MAX_DEPTH + 1):  # every valid chain of parents ends within these steps
        parents = rows["parent"][at].astype(np.int64)
        if len(at) and (parents.min() < -1 or parents.max() >= len(rows)):
            raise fault("section 'cells'", "parents that are cells", "others")
        at = parents[parents >= 0]
    if len(at) or (len(rows) and rows["visible"].max() > gaussians):
        raise fault("section 'cells'", "short chains of parents and sets of the scene", "others")
    return rows
