"""Open the visible sets of a package directly from its parts, without joining them or parsing the manifest again."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsvis.errors import FormatError, SceneError
from gsvis.files.cache import Cache
from gsvis.files.joined import JoinedFiles
from gsvis.package.manifest import Manifest
from gsvis.package.parts import PartFolder
from gsvis.pvs.store import VisibilityStore

__all__ = ["open_sets"]

_REMEDY = "prepare the package again"
_MOST_HELD = 128  # files that stay open, 128 MiB of sets; a process may have about 1,000 files and sockets


def open_sets(
    parts: Path,
    manifest: Manifest,
    cache: Cache[Any] | None = None,
    *,
    order: NDArray[np.int32] | None = None,
    is_held: bool = False,
) -> VisibilityStore:
    """Open the visible sets of a package.

    Data is checked by the checksums of the store when read, not against the names of the parts.

    Args:
        parts: Folder of the parts.
        manifest: The manifest of the package.
        cache: Cache for decoded data; None means a new one.
        order: (N,) `VisibilityStore.order`, if it is known.
        is_held: Whether to keep the files open, at most 128, so that they can be read even after they are removed.

    Raises:
        SceneError: If the package has no visible sets.
        FormatError: If the store is damaged, or belongs to a different scene.
    """
    blob = manifest.visibility
    if blob is None:
        raise SceneError(f"{parts.parent}: the package has no visible sets; prepare it with visibility")
    folder = PartFolder(parts)
    paths = [folder.check_size(part) for part in blob.parts]
    joined = JoinedFiles(paths, [part.nbytes for part in blob.parts], is_held=is_held and len(paths) <= _MOST_HELD)
    try:
        store = VisibilityStore(parts.parent / "sets.pvs", joined=joined, cache=cache, order=order)
    except BaseException:
        joined.close()
        raise
    if store.info.scene != manifest.scene or store.gaussians != manifest.gaussians:
        store.close()
        got = f"{store.info.scene[:12]}..."
        raise FormatError(parts.parent, "visibility", f"sets of {manifest.scene[:12]}...", got, _REMEDY)
    return store
