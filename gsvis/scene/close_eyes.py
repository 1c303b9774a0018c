"""Draw eyes that are close to what stops light: under a ceiling, along a wall, beside a statue. Scene frame.

Eyes drawn evenly in navigable space are seldom there, because little of its volume is. A large Gaussian that is right
from afar covers half of the picture there.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gsvis.scene.gaussians import Gaussians
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.solid import buried

__all__ = ["draw_close_eyes"]

_AMONG = 10  # eyes drawn for each that is returned


def draw_close_eyes(g: Gaussians, space: NavigableSpace, count: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """Return viewpoints that are nearer to an occupied voxel than nine of ten are.

    Args:
        g: The scene; no viewpoint lies in a solid part of it.
        space: Allowed viewpoints, and the voxels that stop light.
        count: Number of viewpoints.
        rng: Source of randomness.

    Returns:
        (C, 3) viewpoints in random order, C <= count; none where no voxel is occupied.
    """
    from scipy.spatial import cKDTree  # slow to import, and seldom needed

    walls = np.argwhere(space.occupied)
    if len(walls) == 0 or count == 0:
        return np.zeros((0, 3))
    eyes = space.sample_viewpoints(_AMONG * count, rng)
    eyes = eyes[~buried(g, eyes)]
    in_voxels = (eyes - space.origin) / space.voxel_size
    away = cKDTree(walls + 0.5).query(in_voxels)[0]
    nearest = np.argsort(away, kind="stable")[:count]
    return np.asarray(eyes[rng.permutation(nearest)])
