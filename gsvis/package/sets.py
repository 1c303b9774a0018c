"""The visible sets of a package, read from its parts as they lie: nothing is joined, and no manifest parsed again."""

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
_MOST_HELD = 128  # files: sets of 128 MiB; a process may have about a thousand open files, sockets among them


def open_sets(
    parts: Path,
    manifest: Manifest,
    cache: Cache[Any] | None = None,
    *,
    order: NDArray[np.int32] | None = None,
    is_held: bool = False,
) -> VisibilityStore:
    """Open the visible sets of a package.

    What is read is checked against the checksums in the store, not against the names of the parts.

    Args:
        parts: Folder of the parts.
        manifest: The manifest of the package.
        cache: Keeps all that is decoded; None means one of its own.
        order: (N,) `VisibilityStore.order`, where it is known.
        is_held: Whether to keep the files open, unless they are many: they can be read after somebody removed them.

    Raises:
        SceneError: If the package has no visible sets.
        FormatError: If the store is damaged, or belongs to another scene.
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
