"""The navigable space of a scene, found once in a process: commands of many tests look at the same small scenes.

Only for tests of what commands do with a space. How it is found, and that it is found again, is tested in tests/scene.
"""

from __future__ import annotations

import hashlib
import pickle
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gsvis.scene.gaussians import Gaussians
from gsvis.scene.navigable import NavigableSpace

__all__ = ["coarse_spaces", "remember_spaces"]

_MOST = 64
_from_scene = NavigableSpace.from_scene
_found: dict[str, NavigableSpace] = {}


@contextmanager
def remember_spaces(folder: Path | None = None) -> Iterator[None]:
    """Let `NavigableSpace.from_scene` return what it returned for the same arrays and options; errors come anew.

    Processes that name the same folder share what they find.
    """

    def remember(g: Gaussians, **options: Any) -> NavigableSpace:
        return _remember(g, folder, options)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(NavigableSpace, "from_scene", staticmethod(remember))
        yield


@contextmanager
def coarse_spaces(most: int = 64) -> Iterator[None]:
    """Let `NavigableSpace.from_scene` take at most so many voxels along a side: rays and walls then cost a tenth."""
    from_scene = NavigableSpace.from_scene

    def coarser(g: Gaussians, **options: Any) -> NavigableSpace:
        return from_scene(g, **{**options, "resolution": min(options.get("resolution", most), most)})

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(NavigableSpace, "from_scene", staticmethod(coarser))
        yield


def _remember(g: Gaussians, folder: Path | None, options: dict[str, Any]) -> NavigableSpace:
    key = _name(g, options)
    if key not in _found:
        if len(_found) >= _MOST:
            _found.pop(next(iter(_found)))
        file = folder / f"{key}.pickle" if folder is not None else None
        if file is not None and file.exists():
            _found[key] = pickle.loads(file.read_bytes())
        else:
            _found[key] = _from_scene(g, **options)
            if file is not None:
                file.write_bytes(pickle.dumps(_found[key]))
    return _found[key]


def _name(g: Gaussians, options: dict[str, Any]) -> str:
    """Return a hash of every array and option."""
    digest = hashlib.blake2b()
    for name, value in [*sorted(vars(g).items()), *sorted(options.items())]:
        array = np.asarray(value) if value is not None else np.zeros(0)
        digest.update(f"{name} {array.dtype} {array.shape}".encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()
