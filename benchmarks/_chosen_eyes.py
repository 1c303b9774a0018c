"""Eyes that a person chose, by looking at renders: 30 for each scene, with what the scene is and which way is up.

Chosen by hand on 28 November 2026, without a look at what gsvis finds. Rooms: points on a floor plan, at the height of
an eye. Objects: rings from which the whole object fits into a picture, and nearer ones. Captures of one front: within
40 degrees of it. Bonsai: every ninth of its photographs. Scene frame and units.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gsvis.io import load_cameras, load_scene
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.procedural import builtin_scene

__all__ = ["CHOSEN", "Chosen", "load_chosen"]

F64 = NDArray[np.float64]
Triple = tuple[float, float, float]

COUNT = 30
_BONSAI_UP = (0.033, -0.736, -0.677)  # orthogonal to all right axes of the photographs


@dataclass(frozen=True)
class Chosen:
    """What a person says of a scene.

    Attributes:
        name: Name of the scene.
        path: Below the folder of real data; a built-in scene begins with "builtin:".
        kinds: What it may rightly be taken for.
        up: Directions that may rightly be taken for up; empty where a person cannot tell.
        eyes: (30, 3) eyes.
        targets: (30, 3) what each looks at.
        lod: Level of detail of a streamed scene.
    """

    name: str
    path: str
    kinds: tuple[str, ...]
    up: tuple[Triple, ...]
    eyes: F64
    targets: F64
    lod: int | None = None


def load_chosen(chosen: Chosen, folder: Path) -> Gaussians:
    """Return the Gaussians of a scene."""
    if chosen.path.startswith("builtin:"):
        return builtin_scene(chosen.path.removeprefix("builtin:")).gaussians
    path = folder / chosen.path
    return _points(path) if path.suffix == ".npz" else load_scene(path, lod=chosen.lod)


def _points(path: Path) -> Gaussians:
    """Return colored points as Gaussians as wide as the mean distance of their three neighbors."""
    from scipy.spatial import cKDTree

    points = np.load(path)
    means = points["means3d"]
    squared = cKDTree(means).query(means, 4)[0][:, 1:] ** 2
    scales = np.maximum(np.sqrt(squared.mean(axis=1)), 1e-6)
    colors = points["colors"] / 255.0
    count = len(means)
    return Gaussians(
        means,
        np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)),
        np.tile(scales[:, None], (1, 3)),
        np.full(count, 0.8),
        ((colors - 0.5) / 0.28209479)[:, None, :],
    )


def _around(middle: Triple, up: Triple, rings: Sequence[tuple[float, float, int]]) -> tuple[F64, F64]:
    """Return eyes on rings around an object, each (radius, height above the middle, count), that look at it."""
    axis = np.array(up, np.float64)
    east = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
    east /= np.linalg.norm(east)
    north = np.cross(axis, east)
    eyes = []
    for number, (radius, height, count) in enumerate(rings):
        turns = 2.0 * np.pi * (np.arange(count) + 0.37 * number) / count
        flat = radius * (np.cos(turns)[:, None] * east + np.sin(turns)[:, None] * north)
        eyes.append(np.array(middle) + flat + height * axis)
    found = np.concatenate(eyes)
    return found, np.tile(np.array(middle, np.float64), (len(found), 1))


def _before(middle: Triple, radii: Sequence[float], heights: Sequence[float]) -> tuple[F64, F64]:
    """Return eyes in front (+z) of a capture of one front, within 40 degrees; -y is up."""
    eyes = []
    for radius in radii:
        for height in heights:
            for degrees in (-40.0, -25.0, -10.0, 10.0, 25.0):
                turn = np.radians(degrees)
                eyes.append((radius * np.sin(turn), -height, radius * np.cos(turn)))
    found = np.array(middle) + np.array(eyes)
    return found, np.tile(np.array(middle, np.float64), (len(found), 1))


def _on_floor(places: Sequence[tuple[float, float]], height: float) -> tuple[F64, F64]:
    """Return eyes over a plan (x, y) with +z up; each looks at the next place."""
    eyes = np.array([(x, y, height) for x, y in places])
    return eyes, np.roll(eyes, -1, axis=0)


_SHOWROOM = _on_floor(
    (
        (1.0, -3.0), (3.0, -4.0), (5.0, -3.0), (4.0, -6.0), (0.0, -1.0), (-2.0, -3.0), (6.0, -5.0), (2.0, -1.5),
        (-1.5, -4.5), (4.0, -1.5), (-1.0, -12.0), (0.5, -9.5), (0.8, -12.5), (-0.5, -14.3), (1.5, -8.0), (-2.0, -17.5),
        (-2.0, -19.0), (-1.2, -16.5), (-7.0, -12.0), (-8.0, -13.0), (-7.0, -9.5), (-11.0, -11.0), (-10.5, -9.5),
        (-10.5, -12.0), (-11.0, -4.0), (-6.5, -1.0), (-6.0, 0.5), (-5.5, -3.0), (4.0, -11.0), (3.5, -13.0),
    ),
    0.9,
)  # fmt: skip


def _on_platform() -> tuple[F64, F64]:
    """Return eyes on the platform of nika: at the wall, along the railing, and some lower ones."""
    places = (
        (0.0, 0.8), (-1.0, 0.5), (-2.0, 0.6), (1.0, 1.0), (1.0, 0.2), (0.0, 0.0), (-1.0, -0.2), (-2.0, 0.0), (0.5, 1.5),
        (1.4, 1.8), (-0.5, 1.2), (-1.5, 1.0), (-2.5, 0.4), (1.5, 0.8), (0.5, 0.5), (0.0, -0.5), (1.0, -0.5),
        (-1.0, -0.6), (1.6, 0.0), (1.5, -0.5),
    )  # fmt: skip
    standing = [(x, -1.4, z) for x, z in places]
    lower = [(x, -1.0, z) for x, z in places[:10]]
    eyes = np.array(standing + lower)
    wall, meadow = np.array([2.2, -1.2, 1.0]), np.array([0.0, -1.0, 6.0])
    targets = np.where((np.arange(len(eyes)) % 3 == 2)[:, None], meadow, wall)
    return eyes, targets


_DOWN_Y = (0.0, -1.0, 0.0)
_Z = (0.0, 0.0, 1.0)
_OBJECT = ("object",)

_OBJECTS = (
    ("biker", "scenes/formats/biker.spz", (-0.05, -1.5, 0.0), ((2.0, 1.1, 10), (3.0, 1.1, 12), (1.4, 0.7, 8))),
    (
        "guitar",
        "scenes/formats/guitar.compressed.ply",
        (0.1, -1.9, 0.2),
        ((2.2, 0.5, 8), (3.5, 1.0, 12), (4.6, 1.5, 10)),
    ),
    ("massa", "scenes/statues/massa.sog", (0.0, -0.4, 0.0), ((1.8, 0.6, 8), (2.6, 0.6, 12), (3.4, 0.3, 10))),
    ("trumpet", "scenes/statues/trumpet.sog", (0.1, -0.5, 0.0), ((1.8, 0.6, 8), (2.5, 0.6, 12), (3.3, 0.3, 10))),
)


def _scenes() -> Iterator[Chosen]:
    """Yield all but bonsai."""
    yield Chosen("showroom", "scenes/showroom/lod-meta.json", ("rooms",), (_Z,), *_SHOWROOM, lod=3)
    yield Chosen("nika", "scenes/nika_sh3/lod-meta.json", ("open place",), (_DOWN_Y,), *_on_platform(), lod=1)
    around = _around((0.0, -0.08, 0.0), _DOWN_Y, ((0.3, 0.12, 8), (0.4, 0.2, 12), (0.5, 0.25, 10)))
    ground = ("object", "open place")
    yield Chosen("flowers", "scenes/flowers_sh2/lod-meta.json", ground, (_DOWN_Y,), *around, lod=1)
    for name, path, middle, rings in _OBJECTS:
        yield Chosen(name, path, _OBJECT, (_DOWN_Y,), *_around(middle, _DOWN_Y, rings))
    person = _around((0.0, -0.45, 0.0), (0.0, 1.0, 0.0), ((1.2, 0.5, 8), (1.7, 0.5, 12), (2.3, 0.3, 10)))
    path = "scenes/formats/gsplayer_scene.compressed.ply"
    yield Chosen("gsplayer", path, _OBJECT, ((0.0, 1.0, 0.0),), *person)
    front = _before((1.35, 0.75, -5.9), (1.0, 1.4), (-0.2, 0.0, 0.2))
    unclear = ("object", "open place", "rooms")
    yield Chosen("arkit", "scenes/formats/arkit_scene.splat", unclear, (), *front)
    front = _before((0.0, -0.2, -0.2), (0.9, 1.2), (-0.05, 0.1, 0.25))
    yield Chosen("relief", "scenes/uncropped/relief.sog", ground, (_DOWN_Y,), *front)
    front = _before((0.0, 0.0, 0.1), (1.5, 2.2), (-0.2, 0.0, 0.3))
    yield Chosen("owl", "scenes/uncropped/owl.sog", _OBJECT, (_DOWN_Y,), *front)
    table = _around((0.0, 0.0, 0.2), _Z, ((1.0, 0.32, 10), (1.15, 0.38, 12), (0.9, 0.5, 8)))
    yield Chosen("garden", "scenes/formats/garden_points.npz", ground, (_Z,), *table)


def _builtin() -> Iterator[Chosen]:
    """Yield built-in scenes; eyes drawn in their known space and looked at."""
    for name in ("two_rooms", "box_in_room"):
        made = builtin_scene(name)
        eyes = made.navigable.sample_viewpoints(COUNT, np.random.default_rng(28))
        middle = made.gaussians.means.mean(axis=0, dtype=np.float64)
        up = tuple(float(value) for value in made.navigable.up)
        yield Chosen(name, f"builtin:{name}", ("rooms",), (up,), eyes, np.tile(middle, (COUNT, 1)))  # type: ignore[arg-type]


def bonsai(scene: str, folder: Path) -> Chosen:
    """Return bonsai, from a scene that was trained on its photographs: 30 of their eyes.

    Args:
        scene: Path of the trained scene; `gsvis train` makes one.
        folder: The folder of real data.
    """
    cameras = load_cameras(folder / "photos/bonsai/sparse/0")
    picked = cameras[np.arange(4, len(cameras), 9)[:COUNT]]
    targets = picked.viewpoints + 3.0 * picked.forwards
    return Chosen("bonsai", scene, ("rooms", "open place", "object"), (_BONSAI_UP,), picked.viewpoints, targets)


CHOSEN = (*_scenes(), *_builtin())
"""All scenes but bonsai."""
