"""What a scene is, as one short string: files that were made from a scene name it by its content, not by its path."""

from __future__ import annotations

import hashlib

import numpy as np

from gsvis.scene.gaussians import Gaussians
from gsvis.scene.navigable import NavigableSpace

__all__ = ["scene_hash", "space_hash"]

_ARRAYS = ("means", "quats", "scales", "opacities", "sh0", "shN")


def scene_hash(g: Gaussians) -> str:
    """SHA-256 over the number of Gaussians and all their arrays, in their order, as 64 hexadecimal digits.

    Equal for equal arrays whatever file they came from; a permutation, a change of the last bit, or another SH degree
    gives another hash.

    Args:
        g: The scene.
    """
    digest = hashlib.sha256(b"gsvis scene 1\n%d\n" % len(g))
    for name in _ARRAYS:
        array = np.ascontiguousarray(getattr(g, name), dtype="<f4")
        digest.update(f"{name} {array.shape}\n".encode())
        digest.update(array.data if array.size else b"")
    return digest.hexdigest()


def space_hash(space: NavigableSpace) -> str:
    """SHA-256 over the grid of a navigable space and its free voxels, as 64 hexadecimal digits.

    Args:
        space: Where eyes may be; what stops light in it, targets and the up axis do not count.
    """
    digest = hashlib.sha256(np.packbits(space.free).tobytes())
    digest.update(np.concatenate([space.origin, [space.voxel_size], space.free.shape]).astype("<f8").tobytes())
    return digest.hexdigest()
