"""Choose few Gaussians that stand for a scene in a first picture. Scene frame and units."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gsvis.scene.gaussians import Gaussians

__all__ = ["stand_ins"]

_SEED = 0
_ROUNDS = 20  # of the search for the factor at which as many as wanted are chosen
_LEAST = 1e-12  # area that counts, over the largest
_MOST_GROWTH = 3.0  # of a chosen one, over what an even sample would grow by


def stand_ins(sample: Gaussians, whole: int, most: int) -> Gaussians:
    """Return about `most` Gaussians of a sample, enlarged so that each stands for the area of those left out.

    A Gaussian is chosen with a probability in proportion to its area times its opacity, at most 1, and its area grows
    by the inverse of it: the expected covered area is that of the scene (Horvitz and Thompson 1952). So large Gaussians
    stay, and small ones are thinned.

    Args:
        sample: An even sample of the scene, not empty.
        whole: Number of Gaussians of the scene.
        most: Wanted number, at least 1; fewer are chosen where the sample has fewer.
    """
    areas = np.sort(sample.scales.astype(np.float64), axis=1)[:, 1:].prod(axis=1) * sample.opacities
    largest = float(areas.max(initial=0.0))
    areas = np.maximum(areas / largest, _LEAST) if largest > 0.0 else np.ones(len(sample))
    factor = most / float(areas.sum())
    for _ in range(_ROUNDS):
        factor *= most / float(np.minimum(1.0, factor * areas).sum())
    chances = np.minimum(1.0, factor * areas)
    chosen = np.flatnonzero(np.random.default_rng(_SEED).random(len(sample)) < chances)
    growth = np.sqrt(whole / len(sample) / chances[chosen])
    growth = np.minimum(growth, _MOST_GROWTH * np.sqrt(whole / min(most, len(sample))))
    some = sample[chosen]
    scales = np.minimum(some.scales * growth[:, None], np.finfo(np.float32).max)
    return replace(some, scales=scales.astype(np.float32))
