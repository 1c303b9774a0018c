"""What a long preparation has found so far, in one file beside its result, so that a killed run goes on from there.

The file is named after what was asked for, so that runs of different settings never meet in one. A damaged one counts
as missing. `gsvis.visibility._journal` does the same for builds of many cells.
"""

from __future__ import annotations

import hashlib
import json
import os
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsvis import _check
from gsvis.io.atomic import atomic_path

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

    def load(self, shapes: Mapping[str, tuple[int, ...]]) -> dict[str, NDArray[Any]]:
        """What was kept, where it is whole and of these shapes.

        Args:
            shapes: Of the arrays that may be there.
        """
        if self.path is None:
            return {}
        try:
            with self.path.open("rb") as raw, np.load(raw, allow_pickle=False) as file:
                found = {name: file[name] for name in shapes if name in file.files}
        except (OSError, ValueError, EOFError, zipfile.BadZipFile):
            return {}
        return {name: array for name, array in found.items() if array.shape == shapes[name]}

    def save(self, **arrays: NDArray[Any]) -> None:
        """Keep these instead of what was kept before.

        Raises:
            OSError: If the file cannot be written.
        """
        if self.path is not None:
            with atomic_path(self.path) as partial, partial.open("wb") as file:
                np.savez(file, **arrays)  # type: ignore[arg-type]  # names are not those of its own parameters

    def remove(self) -> None:
        """Nothing is kept any more."""
        if self.path is not None:
            self.path.unlink(missing_ok=True)
