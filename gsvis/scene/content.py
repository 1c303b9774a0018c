"""Hash a scene by content, so that files made from it can identify it independently of its path."""

from __future__ import annotations

import hashlib
from weakref import WeakKeyDictionary

import numpy as np

from gsvis.scene.gaussians import Gaussians
from gsvis.scene.navigable import NavigableSpace

__all__ = ["scene_hash", "sight_hash", "space_hash"]

_known: WeakKeyDictionary[Gaussians, str] = WeakKeyDictionary()
_ARRAYS = ("means", "quats", "scales", "opacities", "sh0", "shN")


def scene_hash(g: Gaussians) -> str:
    """Return the SHA-256 of the number of Gaussians and all their arrays, in order, as 64 hexadecimal digits.

    Equal arrays give equal hashes, independently of the file format. A permutation, a changed bit or a different SH
    degree changes the hash.

    The hash of an object is found once.

    Args:
        g: The scene.
    """
    if g not in _known:
        _known[g] = _digest_of(g)
    return _known[g]


def _digest_of(g: Gaussians) -> str:
    """Return the hash of a scene."""
    digest = hashlib.sha256(b"gsvis scene 1\n%d\n" % len(g))
    for name in _ARRAYS:
        array = np.ascontiguousarray(getattr(g, name), dtype="<f4")
        digest.update(f"{name} {array.shape}\n".encode())
        digest.update(array.data if array.size else b"")
    return digest.hexdigest()


def sight_hash(space: NavigableSpace) -> str:
    """Return a hash of all inputs of `InSight`: the grid, the free and the occupied voxels."""
    return space_hash(space) + hashlib.sha256(np.packbits(space.occupied).tobytes()).hexdigest()


def space_hash(space: NavigableSpace) -> str:
    """Return the SHA-256 of a navigable space's grid and free voxels, as 64 hexadecimal digits.

    Args:
        space: The navigable space; occupied voxels, targets and the up axis do not change the hash.
    """
    digest = hashlib.sha256(np.packbits(space.free).tobytes())
    digest.update(np.concatenate([space.origin, [space.voxel_size], space.free.shape]).astype("<f8").tobytes())
    return digest.hexdigest()
