"""What a long preparation has found so far, in one file beside its result, so that a killed run goes on from there.

The file is named after what was asked for, so that runs of different settings never meet in one. A damaged one counts
as missing. `gsvis.pvs._journal` does the same for builds of many cells.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsvis import _check
from gsvis.errors import FormatError
from gsvis.files.archive import load_arrays, save_arrays
from gsvis.files.atomic import remove_partials

__all__ = ["Kept"]


class Kept:
    """Arrays by name, in a file or, without a path, nowhere.

    Args:
        beside: The result that is being made; None keeps nothing.
        plan: All that decides the arrays; JSON values.

    Attributes:
        path: The file, which need not exist; None if nothing is kept.
    """

    def __init__(self, beside: str | os.PathLike[str] | None, plan: Mapping[str, Any]) -> None:
        self.path: Path | None = None
        if beside is not None:
            target = _check.path("keep", beside)
            digest = hashlib.sha256(json.dumps(dict(plan), sort_keys=True).encode()).hexdigest()
            self.path = target.with_name(f"{target.name}.partial-{digest[:12]}.npz")

    def load(self, like: Mapping[str, tuple[tuple[int, ...], type[np.generic]]]) -> dict[str, NDArray[Any]]:
        """Return what was kept, where it is whole and of these shapes and types; a damaged file counts as missing.

        Args:
            like: Shape and type of the arrays that may be there.
        """
        if self.path is None:
            return {}
        try:
            found = load_arrays(self.path, sealed=True)
        except (OSError, FormatError):
            return {}
        return {name: array for name, array in found.items() if like.get(name) == (array.shape, array.dtype.type)}

    def save(self, **arrays: NDArray[Any]) -> None:
        """Keep these instead of what was kept before.

        Raises:
            OSError: If the file cannot be written.
        """
        if self.path is not None:
            save_arrays(self.path, arrays)

    def remove(self) -> None:
        """Remove the file, and what a kill left of a write of it."""
        if self.path is not None:
            self.path.unlink(missing_ok=True)
            remove_partials(self.path)
