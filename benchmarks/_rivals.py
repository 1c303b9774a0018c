"""Other ways to make a scene smaller, to compare levels with: what each takes and what it leaves.

An octree in the manner of Octree-GS, the heaviest Gaussians, `splat-transform`'s decimations, two densities drawn
together, and images with fewer pixels. Each takes a scene (or images) and says nothing about quality.
"""

from __future__ import annotations

import hashlib
import os
import subprocess
import tempfile
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image

from gsvis.io import load_scene, save_scene
from gsvis.scene.content import scene_hash
from gsvis.scene.gaussians import Gaussians, quats_from_rotations

__all__ = [
    "DECIMATIONS",
    "decimated",
    "digest",
    "downsampled_images",
    "heaviest",
    "merged_by_cell",
    "merged_densities",
    "occupied_voxels",
    "octree",
]

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

DECIMATIONS = ("decimate", "decimate-adaptive")
SPLAT_TRANSFORM = "3.7.0"

_SIDE = 2**20  # voxels to either side of the middle; what lies farther shares the outermost
_MOST_OPAQUE = 0.996  # as far as a byte goes
_KNUD_THOMSEN = 1.6  # surface of an ellipsoid to about 1%


def octree(g: Gaussians, count: int) -> Gaussians:
    """The level of an octree of a scene that shows `count` Gaussians: one for each voxel that holds any.

    Octree-GS keeps an anchor for each occupied voxel of an octree, in layers by the size of the voxels, and shows what
    the anchors of a layer hold; it trains them. Here there are no photographs to train on, so that each anchor takes
    over what its voxel holds. The rules:

    - The grid of a layer has its corner at the median of the centres. Depths of an octree double the number of voxels
      along a side; to hit a count, the side is bisected until the occupied voxels are at least `count` and at most 1%
      more, or for 60 steps, and of those the ones with the least coverage are left out.
    - A Gaussian counts by its coverage w: its opacity times the mean area of its shadows, a quarter of its surface.
    - An anchor has the first two moments of its Gaussians as weighted by w (the mean, and the covariances plus the
      scatter of the means), and the mean of their SH coefficients.
    - Its opacity keeps the coverage: the sum of w over its own mean shadow, at most 0.996. A voxel with one Gaussian
      shows that Gaussian as it is.

    Args:
        g: N Gaussians.
        count: How many to leave, 1 to the number of different centres.

    Returns:
        `count` Gaussians, by falling coverage.

    Raises:
        ValueError: If no size of voxel gives as many as `count`.

    References:
        Ren et al., "Octree-GS: Towards consistent real-time rendering with LOD-structured 3D Gaussians", 2024;
        SRBF-Gaussian, section 3.2 and figures 4 and 18. Opacity from coverage as in Kerbl et al., "A hierarchical 3D
        Gaussian representation for real-time rendering of very large datasets", 2024, section 4.1.
    """
    cells = _cells_for(g, count)
    number = int(cells.max()) + 1
    coverage = np.bincount(cells, g.opacities * _mean_shadows(g.scales.astype(np.float64)), minlength=number)
    kept = np.argsort(-coverage, kind="stable")[:count]
    place = np.full(number, -1)
    place[kept] = np.arange(count)
    inside = place[cells] >= 0
    return merged_by_cell(g[inside], place[cells[inside]])


def _cells_for(g: Gaussians, count: int) -> I64:
    """(N,) the voxel of each Gaussian, 0 to at least count - 1, with as few voxels as bisection finds."""
    if not 1 <= count <= len(g):
        raise ValueError(f"count: expected 1 to {len(g)}, got {count}")
    means = g.means.astype(np.float64)
    middle = np.median(means, axis=0)
    span = float(np.abs(means - middle).max()) or 1.0
    low, high = np.log(span / _SIDE), np.log(4.0 * span)  # of the side; many voxels at the low end
    best = occupied_voxels(means - middle, float(np.exp(low)))
    if best.max() + 1 < count:
        raise ValueError(f"count: expected at most {best.max() + 1} of {len(g)} with centres this close, got {count}")
    for _ in range(60):
        side = 0.5 * (low + high)
        cells = occupied_voxels(means - middle, float(np.exp(side)))
        if cells.max() + 1 >= count:
            low, best = side, cells
            if best.max() + 1 <= 1.01 * count:
                break
        else:
            high = side
    return best


def occupied_voxels(points: F64, side: float) -> I64:
    """(N,) which occupied voxel each of the (N, 3) points lies in, numbered from 0, for cubes of a side."""
    steps = np.clip(np.floor(points / side), -_SIDE, _SIDE - 1).astype(np.int64) + _SIDE
    keys = (steps[:, 0] << 42) | (steps[:, 1] << 21) | steps[:, 2]
    return np.asarray(np.unique(keys, return_inverse=True)[1], np.int64).reshape(-1)


def merged_by_cell(g: Gaussians, cells: I64) -> Gaussians:
    """One Gaussian for each cell, by the rules of `octree`.

    Args:
        g: N Gaussians.
        cells: (N,) the cell of each, 0 to M - 1, none of them empty.

    Returns:
        M Gaussians, in the order of the cells.
    """
    number = int(cells.max()) + 1
    order = np.argsort(cells, kind="stable")
    starts = np.searchsorted(cells[order], np.arange(number))
    shadows = _mean_shadows(g.scales.astype(np.float64))
    weights = np.maximum(g.opacities * shadows, 1e-30)  # a cell of invisible ones has a mean too
    total = np.add.reduceat(weights[order], starts)

    def mean(values: NDArray[np.floating]) -> F64:
        weighted = values.reshape(len(values), -1) * weights[:, None]
        sums = np.add.reduceat(weighted[order], starts, axis=0) / total[:, None]
        return sums.reshape(number, *values.shape[1:])

    middle = np.median(g.means, axis=0).astype(np.float64)
    means = mean(g.means - middle)
    away = (g.means - middle) - means[cells]
    covars = mean(g.covars() + away[:, :, None] * away[:, None, :])
    squares, axes = np.linalg.eigh(covars)
    scales = np.sqrt(np.maximum(squares, np.maximum(1e-12 * squares[:, 2:], 1e-18)))
    axes[:, :, 0] *= np.sign(np.linalg.det(axes))[:, None]
    visible = np.add.reduceat((g.opacities * shadows)[order], starts)
    alone = np.bincount(cells, minlength=number) == 1
    merged = {
        "means": means + middle,
        "quats": quats_from_rotations(axes),
        "scales": scales,
        "opacities": np.minimum(visible / _mean_shadows(scales), _MOST_OPAQUE),
        "sh0": mean(g.sh0),
        "shN": mean(g.shN) if g.sh_degree else np.zeros((number, 0, 3)),
    }
    same = order[starts[alone]]
    for name, values in merged.items():
        values[alone] = getattr(g, name)[same]
    return Gaussians(**merged)


def _mean_shadows(scales: F64) -> F64:
    """(N,) mean area over all directions of the shadow of ellipsoids with these half axes: a quarter of the surface."""
    a, b, c = (scales**_KNUD_THOMSEN).T
    return np.asarray(np.pi * ((a * b + b * c + c * a) / 3.0) ** (1.0 / _KNUD_THOMSEN))


def heaviest(g: Gaussians, weights: ArrayLike, count: int) -> Gaussians:
    """The `count` Gaussians of largest weight, in the order of the scene; of equal weights the first."""
    order = np.argsort(-np.asarray(weights, np.float64), kind="stable")
    return g[np.sort(order[:count])]


def decimated(g: Gaussians, count: int, adaptive: bool, cache: Path) -> Gaussians:
    """What `splat-transform --decimate` (or `--decimate-adaptive`) leaves, which takes minutes for large scenes.

    The npm package is installed once below `cache`, by the ordinary client; results stay there by scene and count.

    Args:
        g: N Gaussians.
        count: How many to leave.
        adaptive: Whether removal follows the local error.
        cache: Folder.

    Raises:
        FileNotFoundError: If there is no node or npm.
        subprocess.CalledProcessError: If either fails.
    """
    mode = DECIMATIONS[adaptive]
    kept = cache / f"{scene_hash(g)[:16]}-{mode}-{count}.ply"
    if not kept.exists():
        program = _splat_transform(cache)
        with tempfile.TemporaryDirectory(dir=cache) as folder:
            save_scene(g, Path(folder) / "full.ply")
            subprocess.run(
                ["node", program, "-q", "-g", "cpu", "full.ply", f"--{mode}", str(count), "less.ply"],
                cwd=folder,
                check=True,
            )
            os.replace(Path(folder) / "less.ply", kept)
    return load_scene(kept)


def _splat_transform(cache: Path) -> Path:
    """The program's script, installed below the cache if it is not there; version 3.7 runs on Node 20 as well."""
    folder = cache / f"splat-transform-{SPLAT_TRANSFORM}"
    package = folder / "node_modules" / "@playcanvas" / "splat-transform"
    if not package.is_dir():
        folder.mkdir(parents=True, exist_ok=True)
        name = f"@playcanvas/splat-transform@{SPLAT_TRANSFORM}"
        subprocess.run(["npm", "install", "--silent", "--prefix", str(folder), name], cwd=folder, check=True)
    return package / "bin" / "cli.mjs"


def merged_densities(low: Gaussians, high: Gaussians) -> Gaussians:
    """Two scenes of different density drawn together, as an upgrade without shared levels would (paper, figure 5)."""
    return Gaussians.concatenate([low, high])


def downsampled_images(images: ArrayLike, share: float) -> F32:
    """Images with that share of the pixels, shown at the size they had (paper, figure 4).

    Args:
        images: (C, H, W, 3), 1 is white.
        share: Share of the pixels, and of the bytes of images before entropy coding, in (0, 1].

    Returns:
        (C, H, W, 3) float32 in [0, 1]: averaged over areas down, Lanczos up.
    """
    stack = np.asarray(images, np.float32).clip(0.0, 1.0)
    height, width = stack.shape[1:3]
    small = max(round(width * share**0.5), 1), max(round(height * share**0.5), 1)
    shown = np.empty_like(stack)
    for image, out in zip(stack, shown, strict=True):
        for channel in range(3):
            plane = Image.fromarray(np.ascontiguousarray(image[:, :, channel]))
            less = plane.resize(small, Image.Resampling.BOX)
            out[:, :, channel] = np.asarray(less.resize((width, height), Image.Resampling.LANCZOS))
    return shown.clip(0.0, 1.0)


def digest(*arrays: ArrayLike) -> str:
    """Sixteen hexadecimal digits that name the content of arrays, for caches."""
    sha = hashlib.sha256()
    for array in arrays:
        values = np.ascontiguousarray(array)
        sha.update(f"{values.dtype} {values.shape}\n".encode())
        sha.update(values.tobytes())
    return sha.hexdigest()[:16]
