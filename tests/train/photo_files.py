"""A small made-up scene photographed: a COLMAP model or transforms.json with images that a test may damage."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from gsvis.scene.cameras import Cameras
from gsvis.scene.points import PointCloud
from tests.io.colmap_files import write_model

WIDTH, HEIGHT = 48, 32


def cameras(count: int = 10) -> Cameras:
    """Cameras around the origin, named as files."""
    ring = Cameras.orbit((0.0, 0.0, 0.0), 4.0, count, width=WIDTH, height=HEIGHT, fov=60.0)
    return Cameras(ring.viewmats, ring.Ks, WIDTH, HEIGHT, [f"photo_{i:03d}.png" for i in range(count)])


def cloud(count: int = 40) -> PointCloud:
    rng = np.random.default_rng(0)
    return PointCloud(rng.uniform(-1, 1, (count, 3)), np.round(rng.random((count, 3)) * 255) / 255)


def pictures(count: int = 10, width: int = WIDTH, height: int = HEIGHT) -> NDArray[np.uint8]:
    """(C, H, W, 3) smooth pictures, each of its own."""
    x, y = np.meshgrid((np.arange(width) + 0.5) / width, (np.arange(height) + 0.5) / height)
    phases = np.arange(count)[:, None, None]
    waves = [np.sin(2 * np.pi * (x + 0.1 * phases)), np.cos(2 * np.pi * (y - 0.1 * phases)), x * y + 0 * phases]
    return np.round(127.5 + 100.0 * np.stack(waves, axis=-1)).astype(np.uint8)


def write_photos(folder: Path, count: int = 10, points: PointCloud | None = None) -> Path:
    """`sparse/0` and `images` in a folder."""
    views = cameras(count)
    write_model(folder / "sparse" / "0", views, points)
    (folder / "images").mkdir()
    for name, picture in zip(views.names, pictures(count), strict=True):
        Image.fromarray(picture).save(folder / "images" / name)
    return folder


def write_transforms(folder: Path, count: int = 10, *, sizes: bool = True, suffix: str = ".png") -> Path:
    """`transforms.json` and `images` in a folder; without `sizes` and `suffix` as synthetic NeRF data come."""
    views = cameras(count)
    (folder / "images").mkdir()
    frames = []
    for name, pose, picture in zip(views.names, views.viewmats, pictures(count), strict=True):
        Image.fromarray(picture).save(folder / "images" / name)
        world_from_camera = np.linalg.inv(pose) @ np.diag([1.0, -1.0, -1.0, 1.0])
        stem = name.removesuffix(".png")
        frames.append({"file_path": f"./images/{stem}{suffix}", "transform_matrix": world_from_camera.tolist()})
    content = {"camera_angle_x": float(np.radians(60.0)), "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(content | ({"w": WIDTH, "h": HEIGHT} if sizes else {})))
    return folder
