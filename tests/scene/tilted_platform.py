"""A scene that is easily misread: a platform with railings in a wide shell, up tilted by 20 degrees, far outliers."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from gsvis.scene.gaussians import Gaussians
from gsvis.scene.navigable import NavigableSpace

TILT = Rotation.from_euler("x", 20.0, degrees=True).as_matrix()
UP = TILT @ np.array([0.0, 0.0, 1.0])


def tilted_platform(count: int = 2500, seed: int = 7) -> Gaussians:
    """Return a platform 10 units wide with railings and two boxes, a shell around it, and outliers to 50,000 units."""
    rng = np.random.default_rng(seed)
    floor = rng.uniform([-5, -4, -0.05], [5, 4, 0.05], (count, 3))
    rails = []
    for axis, sign in ((0, -1), (0, 1), (1, -1), (1, 1)):
        rail = rng.uniform([-5, -4, 0.0], [5, 4, 1.0], (count // 8, 3))
        rail[:, axis] = sign * (5.0, 4.0)[axis]
        rails.append(rail)
    boxes = [rng.uniform(low, np.add(low, 0.8), (count // 8, 3)) for low in ([-3, 1, 0], [2, -2, 0])]
    near = np.concatenate([floor, *rails, *boxes])
    shell = rng.normal(size=(count // 4, 3))
    shell *= 150.0 / np.linalg.norm(shell, axis=1, keepdims=True)
    far = rng.normal(size=(count // 50, 3))
    far *= (np.geomspace(1e3, 5e4, len(far)) / np.linalg.norm(far, axis=1))[:, None]
    means = np.concatenate([near, shell, far]) @ TILT.T
    scales = np.concatenate([np.full(len(near), 0.16), np.full(len(shell), 12.0), 0.02 * np.linalg.norm(far, axis=1)])
    colors = rng.uniform(-1.5, 1.5, (len(means), 1, 3))
    quats = np.tile([1.0, 0.0, 0.0, 0.0], (len(means), 1))
    return Gaussians(means, quats, np.tile(scales[:, None], (1, 3)), np.full(len(means), 0.97), colors)


def right_eyes() -> NavigableSpace:
    """Return the space of people who stand on the platform."""
    middle = TILT @ np.array([0.0, 0.0, 1.6])
    half = np.array([4.0, 2.6, 0.6])
    return NavigableSpace.from_box(middle - half, middle + half, 16, up=UP)


def wrong_eyes() -> NavigableSpace:
    """Return a space far below the platform and outside of the shell, where nobody stands."""
    middle = TILT @ np.array([0.0, 0.0, -260.0])
    return NavigableSpace.from_box(middle - 20.0, middle + 20.0, 8, up=UP)
