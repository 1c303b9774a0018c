"""Photographs in name order as a walk: ten a second, every eighth held out.

The frame and units are those of the reconstruction. A system sees the training views alone; the judge sees the held-out
photographs alone, at the moments when the walk passes them.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from gsvis.abr import FieldOfView
from gsvis.errors import SceneError
from gsvis.render import rasterize
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians, quats_from_rotations
from gsvis.scene.paths import HeadPath
from gsvis.scene.points import PointCloud
from gsvis.scene.procedural import builtin_scene
from gsvis.train.images import PosedImages
from gsvis.train.initial import gaussians_from_points, random_points
from gsvis.train.photos import Photos, load_photos

__all__ = ["EVERY", "RATE", "Course", "write_synthetic_photos"]

RATE = 10.0
"""Photographs that the walk passes in a second."""

EVERY = 8
"""One photograph in so many is held out, the first of all among them."""

_MARGIN = np.radians(8.0)
_RANDOM_POINTS = 3_000


@dataclass(frozen=True, eq=False)
class Course:
    """The walk, what systems are trained on, and what judges them.

    Attributes:
        name: Name of the scene.
        folder: The photographs, for systems that read them by themselves.
        photos: All of them, sorted by name, in the size of the arena.
        points: Points of the reconstruction; random ones where there are none.
    """

    name: str
    folder: Path
    photos: Photos
    points: PointCloud

    @classmethod
    def open(cls, folder: Path, size: tuple[int, int]) -> Course:
        """Read a folder of photographs.

        Args:
            folder: A COLMAP model or a `transforms.json`, with its photographs.
            size: (width, height) in pixels to shrink them to.

        Raises:
            FileNotFoundError: If there is no such folder.
            FormatError: If photographs are missing or damaged, or nothing says where they were taken from.
            SceneError: If there are fewer than two to judge by.
        """
        photos = load_photos(folder, size=size)
        if len(photos.views) <= EVERY:
            raise SceneError(
                f"{folder}: expected more than {EVERY} photographs, two of them to judge by, got {len(photos.views)}"
            )
        points = photos.points
        if points is None:
            points = random_points(photos.views.cameras, _RANDOM_POINTS, np.random.default_rng(0))
        return cls(folder.name, folder, photos, points)

    @cached_property
    def start(self) -> Gaussians:
        """Gaussians that training begins with."""
        return gaussians_from_points(self.points)

    @cached_property
    def views(self) -> PosedImages:
        """Photographs to train on, seven of eight."""
        return self.photos.views.split(EVERY)[0]

    @cached_property
    def held_out(self) -> PosedImages:
        """Photographs to judge by."""
        return self.photos.views.split(EVERY)[1]

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of all photographs, pixels."""
        return self.views.cameras.width, self.views.cameras.height

    @property
    def passed(self) -> NDArray[np.float64]:
        """(H,) seconds at which the walk passes each held-out photograph."""
        return np.arange(len(self.held_out), dtype=np.float64) * (EVERY / RATE)

    @property
    def seconds(self) -> float:
        """Seconds that the walk takes."""
        return len(self.photos.views) / RATE

    @cached_property
    def path(self) -> HeadPath:
        """The walk: the pose of each photograph at its time."""
        cameras = self.photos.views.cameras
        quats = quats_from_rotations(np.swapaxes(cameras.viewmats[:, :3, :3], 1, 2))
        return HeadPath(np.arange(len(cameras)) / RATE, cameras.viewpoints, quats)

    @property
    def field_of_view(self) -> FieldOfView:
        """The field of view of the first photograph, as a client states it."""
        k = self.views.cameras.Ks[0]
        width, height = self.size
        return FieldOfView(
            left=k[0, 2] / k[0, 0],
            right=(width - k[0, 2]) / k[0, 0],
            top=k[1, 2] / k[1, 1],
            bottom=(height - k[1, 2]) / k[1, 1],
            margin=float(_MARGIN),
        )


def write_synthetic_photos(folder: Path, count: int = 24, size: tuple[int, int] = (96, 64)) -> Path:
    """Write photographs of a built-in scene with a `transforms.json`, so that the arena runs without any data.

    Args:
        folder: A new folder.
        count: Number of photographs, along an arc inside the scene.
        size: (width, height), pixels.

    Returns:
        The folder.
    """
    scene = builtin_scene("box_in_room").gaussians
    low, high = np.quantile(scene.means, [0.05, 0.95], axis=0)
    middle = 0.5 * (low + high)
    angles = np.linspace(0.0, np.pi, count)
    reach = 0.35 * (high - low)
    eyes = middle + np.stack([np.cos(angles) * reach[0], np.sin(angles) * reach[1], np.full(count, 0.2)], axis=1)
    cameras = Cameras.look_at(eyes, np.tile(middle, (count, 1)), width=size[0], height=size[1])
    (folder / "images").mkdir(parents=True)
    frames = []
    for c in range(count):
        image = np.clip(rasterize(scene, cameras[c]).images[0], 0.0, 1.0)
        name = f"images/{c:03d}.png"
        Image.fromarray(np.rint(255.0 * image).astype(np.uint8)).save(folder / name)
        world = np.linalg.inv(cameras.viewmats[c]) @ np.diag([1.0, -1.0, -1.0, 1.0])  # OpenGL axes
        frames.append({"file_path": name, "transform_matrix": world.tolist()})
    k = cameras.Ks[0]
    document = {
        "w": size[0], "h": size[1], "fl_x": k[0, 0], "fl_y": k[1, 1], "cx": k[0, 2], "cy": k[1, 2], "frames": frames
    }  # fmt: skip
    (folder / "transforms.json").write_text(json.dumps(document), encoding="utf-8")
    return folder
