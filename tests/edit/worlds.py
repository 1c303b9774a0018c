"""A room with known dirt: a small closed room, a box in it, and Gaussians of each class put in by hand."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gsvis.edit import CLASSES, CleanConfig, class_of
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.procedural import box_in_room

QUICK = CleanConfig(eyes=6, size=64, resolution=96, held_out=2)


@dataclass(frozen=True, eq=False)
class Dirty:
    """A scene of N Gaussians, and (N,) uint8 the class to which each belongs."""

    scene: Gaussians
    classes: NDArray[np.uint8]
    space: NavigableSpace


def dots(means: object, scale: float, opacity: float) -> Gaussians:
    """Round gray Gaussians."""
    at = np.asarray(means, np.float64).reshape(-1, 3)
    n = len(at)
    return Gaussians(
        at, np.tile([1.0, 0, 0, 0], (n, 1)), np.full((n, 3), scale), np.full(n, opacity), np.zeros((n, 1, 3))
    )


def dirty_room() -> Dirty:
    """Two floaters and a puff of fog in the air of a room, two Gaussians in its box, one behind its wall, one far."""
    room = box_in_room(4000, sh_degree=0)
    parts = {
        "floaters": dots([[1.0, 1.0, 1.5], [5.0, 4.0, 1.4]], 0.03, 0.8),
        "fog": dots([[1.2, 3.6, 1.5]], 0.3, 0.06),
        "interior": dots([[3.0, 2.5, 1.5], [3.1, 2.4, 1.2]], 0.05, 0.9),
        "unseen": dots([[-0.15, 2.0, 1.5]], 0.02, 0.9),
        "flyaways": dots([[4000.0, -900.0, 50.0]], 0.5, 0.9),
    }
    assert set(parts) == set(CLASSES)
    numbers = np.concatenate([np.full(len(part), class_of(name), np.uint8) for name, part in parts.items()])
    classes = np.concatenate([np.zeros(len(room.gaussians), np.uint8), numbers])
    return Dirty(Gaussians.concatenate([room.gaussians, *parts.values()]), classes, room.navigable)
