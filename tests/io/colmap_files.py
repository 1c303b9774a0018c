"""Small COLMAP models, binary and text, written plainly and apart from the library's reader."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import quats_from_rotations
from gsvis.scene.points import PointCloud


def write_model(folder: Path, cameras: Cameras, points: PointCloud | None = None, *, text: bool = False) -> Path:
    """A PINHOLE model with one camera for each image; points are written where there are some."""
    folder.mkdir(parents=True, exist_ok=True)
    sizes = [(cameras.width, cameras.height)] * len(cameras)
    return write_mixed(folder, cameras, sizes, points, text=text)


def write_mixed(
    folder: Path,
    cameras: Cameras,
    sizes: list[tuple[int, int]],
    points: PointCloud | None = None,
    *,
    text: bool = False,
) -> Path:
    """As `write_model`, with the size that each image is said to have; intrinsics stay those of `cameras`."""
    folder.mkdir(parents=True, exist_ok=True)
    quats = quats_from_rotations(cameras.viewmats[:, :3, :3])
    rows = list(zip(quats, cameras.viewmats[:, :3, 3], cameras.Ks, cameras.names, sizes, strict=True))
    if text:
        lines = [
            f"{i} PINHOLE {w} {h} {spelled(K[0, 0], K[1, 1], *K[:2, 2])}" for i, (*_, K, _, (w, h)) in counted(rows)
        ]
        posed = [f"{i} {spelled(*quat, *t)} {i} {name}\n" for i, (quat, t, _, name, _) in counted(rows)]
        (folder / "cameras.txt").write_text("# cameras\n" + "\n".join(lines) + "\n")
        (folder / "images.txt").write_text("# images\n" + "\n".join(posed) + "\n")
    else:
        lenses_ = [
            struct.pack("<iiQQ4d", i, 1, w, h, K[0, 0], K[1, 1], *K[:2, 2]) for i, (*_, K, _, (w, h)) in counted(rows)
        ]
        posed_ = [
            struct.pack("<i7di", i, *quat, *t, i) + name.encode() + b"\0" + struct.pack("<Q", 0)
            for i, (quat, t, _, name, _) in counted(rows)
        ]
        (folder / "cameras.bin").write_bytes(struct.pack("<Q", len(rows)) + b"".join(lenses_))
        (folder / "images.bin").write_bytes(struct.pack("<Q", len(rows)) + b"".join(posed_))
    if points is not None:
        write_points(folder / f"points3D.{'txt' if text else 'bin'}", points)
    return folder


def write_points(path: Path, points: PointCloud) -> Path:
    """`points3D.bin` or `.txt`, each point with as many images as its index has remainder by 3."""
    colors = np.round(points.colors * 255).astype(int)
    each = list(zip(points.means.astype(np.float64), colors, strict=True))
    if path.suffix == ".txt":
        lines = [
            f"{i} {spelled(*mean)} {' '.join(map(str, color))} 0.5" + " 1 2" * (i % 3)
            for i, (mean, color) in counted(each)
        ]
        path.write_text("# points\n" + "\n".join(lines) + "\n")
    else:
        body = [
            struct.pack("<Q3d3BdQ", i, *mean, *color, 0.5, i % 3) + struct.pack("<ii", 1, 2) * (i % 3)
            for i, (mean, color) in counted(each)
        ]
        path.write_bytes(struct.pack("<Q", len(each)) + b"".join(body))
    return path


def counted(rows: list) -> list:
    return list(enumerate(rows, 1))


def spelled(*values: float) -> str:
    return " ".join(repr(float(value)) for value in values)
