"""Arrays of a trained system as one file: DEFLATE of an `.npz`, read back with one clear line if it is damaged."""

from __future__ import annotations

import io
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsvis.errors import FormatError
from gsvis.files.limits import read_whole

__all__ = ["deflated", "load_arrays", "save_arrays"]


def save_arrays(path: Path, **arrays: NDArray[Any]) -> int:
    """Write arrays to a file; return its bytes."""
    compressed: Any = np.savez_compressed  # its types leave no room for arrays by name
    with io.BytesIO() as memory:
        compressed(memory, **arrays)
        path.write_bytes(memory.getvalue())
    return path.stat().st_size


def deflated(array: NDArray[Any]) -> int:
    """Return the bytes of an array that is compressed by DEFLATE."""
    return len(zlib.compress(np.ascontiguousarray(array).tobytes(), 9))


def load_arrays(path: Path) -> dict[str, NDArray[Any]]:
    """Return the arrays of a file.

    Raises:
        FormatError: If it is damaged.
    """
    data = read_whole(path)
    remedy = f"delete {path.parent} to train again"
    if not zipfile.is_zipfile(io.BytesIO(data)):
        raise FormatError(path, "", "arrays of a trained system", f"{len(data):,} bytes that are no whole zip", remedy)
    try:
        with np.load(io.BytesIO(data), allow_pickle=False) as found:
            return {name: found[name] for name in found.files}
    except (ValueError, OSError, EOFError, KeyError, zipfile.BadZipFile, zlib.error) as error:
        raise FormatError(path, "", "arrays of a trained system", str(error) or type(error).__name__, remedy) from None
