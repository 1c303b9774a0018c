"""The navigable space and the up axis of a scene, found once: commands of many tests look at the same small scenes.

Only for tests of what commands do with them. How they are found, and that they are found again, is tested in
tests/scene.
"""

from __future__ import annotations

import hashlib
import os
import pickle
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gsvis.scene import source, upright
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.stated import stated_space

__all__ = ["coarse_spaces", "remember_spaces"]

_MOST = 256  # four for a scene
_from_scene = NavigableSpace.from_scene
_from_parts = NavigableSpace.from_parts
_found: dict[str, Any] = {}
_sample_surface = upright.sample_surface
_find_likely = upright.find_likely


@contextmanager
def remember_spaces(folder: Path | None = None) -> Iterator[None]:
    """Let spaces, found or stated, and the likely up axis be what they were for the same arrays and options.

    Errors come anew. Processes that name the same folder share what they find.
    """

    def remember(g: Gaussians, **options: Any) -> NavigableSpace:
        space: NavigableSpace = _remember(_name(g, options), folder, lambda: _from_scene(g, **options))
        return space

    def remember_parts(parts: Iterable[Gaussians], sample: Gaussians, **options: Any) -> NavigableSpace:
        whole = Gaussians.concatenate(list(parts))
        key = f"parts-{_name(sample, options)[:64]}-{_name(whole, {})[:64]}"
        space: NavigableSpace = _remember(key, folder, lambda: _from_parts([whole], sample, **options))
        return space

    def remember_stated(g: Gaussians, *, up: Any = None) -> NavigableSpace | None:
        key = f"stated-{_name(g, {'up': up})}"
        space: NavigableSpace | None = _remember(key, folder, lambda: stated_space(g, up=up))
        return space

    def remember_sample(g: Gaussians) -> Any:
        return _remember(f"sample-{_name(g, {})}", folder, lambda: _sample_surface(g))

    def remember_likely(sample: Any) -> Any:
        return _remember(f"likely-{_name(sample, {})}", folder, lambda: _find_likely(sample))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(NavigableSpace, "from_scene", staticmethod(remember))
        patch.setattr(NavigableSpace, "from_parts", staticmethod(remember_parts))
        patch.setattr(source, "stated_space", remember_stated)
        patch.setattr(upright, "sample_surface", remember_sample)
        patch.setattr(upright, "find_likely", remember_likely)
        yield


@contextmanager
def coarse_spaces(most: int = 64) -> Iterator[None]:
    """Let navigable spaces take at most so many voxels along a side: rays and walls then cost a tenth."""
    from_scene = NavigableSpace.from_scene
    from_parts = NavigableSpace.from_parts

    def coarser(g: Gaussians, **options: Any) -> NavigableSpace:
        return from_scene(g, **{**options, "resolution": min(options.get("resolution", most), most)})

    def coarser_parts(parts: Iterable[Gaussians], sample: Gaussians, **options: Any) -> NavigableSpace:
        return from_parts(parts, sample, **{**options, "resolution": min(options.get("resolution", most), most)})

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(NavigableSpace, "from_scene", staticmethod(coarser))
        patch.setattr(NavigableSpace, "from_parts", staticmethod(coarser_parts))
        yield


def _remember(key: str, folder: Path | None, find: Callable[[], Any]) -> Any:
    if key not in _found:
        if len(_found) >= _MOST:
            _found.pop(next(iter(_found)))
        file = folder / f"{key}.pickle" if folder is not None else None
        if file is not None and file.exists():
            _found[key] = pickle.loads(file.read_bytes())
        else:
            _found[key] = find()
            if file is not None:
                part = file.with_suffix(f".{os.getpid()}")
                with suppress(OSError):  # a test may let no file grow
                    part.write_bytes(pickle.dumps(_found[key]))
                    part.replace(file)  # another process may read it at any time
    return _found[key]


def _name(arrays: Any, options: dict[str, Any]) -> str:
    """Return a hash of every array and option of an object. What is no array, such as facts, counts by its text."""
    digest = hashlib.blake2b()
    for name, value in [*sorted(vars(arrays).items()), *sorted(options.items())]:
        array = np.asarray(value) if value is not None else np.zeros(0)
        digest.update(f"{name} {array.dtype} {array.shape}".encode())
        digest.update(repr(value).encode() if array.dtype.hasobject else np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()
