"""Measure the error of each leaf at each level of detail, by drawing the scene around some eyes.

An error is the mean squared difference of colors, in [0, 1], over what the leaf covers: in the unit of 1 - PSNR, so it
adds up over leaves when it is multiplied with their light. It counts what is seen alone. A leaf has the error of the
eye that shows it worst: the mean over eyes is less than a third of that for a quarter of the leaves. This module knows
no file.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis.export.leaves import Leaves
from gsvis.progress import Progress, silent
from gsvis.render import rasterize
from gsvis.render.weights import share_out
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians

__all__ = ["EYES", "SIDE", "measure_errors", "pick_eyes"]

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

EYES = 16
"""Largest number of eyes around which levels are drawn."""

SIDE = 192
"""Pixels of a side of the six pictures around an eye."""

_LITTLE = 0.01  # gain of a cell, as a share of all leaves, below which no more are added
_ENOUGH = 1e-3  # share of a picture that a leaf covers at least at an eye that counts by itself


def pick_eyes(lights: F64, most: int = EYES) -> I64:
    """Return the cells from which every leaf is seen well: one by one, the cell that adds most.

    Args:
        lights: (K, B) light of each leaf in each cell.
        most: Largest number of cells.
    """
    best = lights.max(axis=0, initial=0.0)
    shares = lights / np.where(best > 0.0, best, 1.0)
    covered = np.zeros(lights.shape[1])
    picked: list[int] = []
    for _ in range(min(most, len(lights))):
        gains = np.maximum(shares - covered, 0.0).sum(axis=1)
        cell = int(gains.argmax())
        if gains[cell] <= _LITTLE * lights.shape[1]:
            break
        picked.append(cell)
        covered = np.maximum(covered, shares[cell])
    return np.array(picked, np.int64)


def measure_errors(leaves: Leaves, eyes: ArrayLike, progress: Progress = silent, *, side: int = SIDE) -> F64:
    """Return the error of each leaf at each level of detail, at the eye where it is largest.

    Each level is drawn as a whole around each eye. The squared difference from the finest level is shared out to the
    leaves that cover a pixel at the finest level.

    Args:
        leaves: B leaves of L levels.
        eyes: (E, 3) eyes, scene frame.
        progress: Called with stage "errors", in eyes.
        side: Pixels of a side of the six pictures around an eye.

    Returns:
        (L, B) mean squared difference of colors from the finest level, in [0, 1]; row 0 is 0. A leaf has its largest
        error at an eye where it covers a thousandth of a picture or more, at least its mean error over all eyes. A leaf
        that no eye sees has the mean error of its level.
    """
    count = len(leaves)
    levels = len(leaves.counts)
    around = np.asarray(eyes, np.float64).reshape(-1, 3)
    if levels == 1 or not len(around):
        return np.zeros((levels, count))
    top = len(leaves.levels) - 1
    scenes = [leaves.levels.level(top - lod) for lod in range(levels)]
    owners = leaves.of_ids[leaves.levels.member(top)]
    sums = np.zeros((levels, count))
    weights = np.zeros(count)
    largest = np.zeros((levels, count))
    progress("errors", 0, len(around))
    for k, eye in enumerate(around):
        own, seen = _measure_eye(scenes, owners, Cameras.cubemap(eye[None], side), count)
        sums += own
        weights += seen
        enough = _ENOUGH * side**2
        largest = np.maximum(largest, np.where(seen >= enough, own / np.maximum(seen, enough), 0.0))
        progress("errors", k + 1, len(around))
    means = sums.sum(axis=1, keepdims=True) / max(float(weights.sum()), 1e-300)
    return np.where(weights > 0.0, np.maximum(largest, sums / np.where(weights > 0.0, weights, 1.0)), means)


def _measure_eye(scenes: list[Gaussians], owners: NDArray[np.int32], faces: Cameras, count: int) -> tuple[F64, F64]:
    """Return (L, B) squared differences of each leaf in the pictures of an eye, summed, and (B,) its pixels."""
    errors = np.zeros((len(scenes), count))
    weights = np.zeros(count)
    inside = owners >= 0
    for camera in (faces[c] for c in range(len(faces))):
        drawn = [np.clip(rasterize(scene, camera).images[0], 0.0, 1.0) for scene in scenes]
        apart = [np.square(image - drawn[0]).mean(axis=-1) for image in drawn]
        shares, seen = share_out(scenes[0], camera, np.stack(apart, axis=-1))
        for lod in range(1, len(scenes)):
            errors[lod] += np.bincount(owners[inside], shares[inside, lod], minlength=count)
        weights += np.bincount(owners[inside], seen[inside], minlength=count)
    return errors, weights
