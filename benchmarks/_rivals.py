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
from gsvis.scene.gaussians import Gaussians
from gsvis.train.merge import merge_gaussians

__all__ = [
    "DECIMATIONS",
    "decimated",
    "digest",
    "downsampled_images",
    "heaviest",
    "merged_densities",
    "octree",
]

F32 = NDArray[np.float32]

DECIMATIONS = ("decimate", "decimate-adaptive")
SPLAT_TRANSFORM = "3.7.0"


def octree(g: Gaussians, count: int) -> Gaussians:
    """The level of an octree of a scene that shows `count` Gaussians: one for each voxel that holds any.

    Octree-GS keeps an anchor for each occupied voxel of an octree, in layers by the size of the voxels, and shows what
    the anchors of a layer hold; it trains them. Here there are no photographs to train on, so that each anchor takes
    over what its voxel holds, by the rules of `merged`: depths of an octree double the number of voxels along a side,
    and to hit a count the side is bisected.

    References:
        Ren et al., "Octree-GS: Toward consistent real-time rendering with LOD-structured 3D Gaussians", 2024;
        SRBF-Gaussian, section 3.2 and figures 4 and 18.
    """
    return merge_gaussians(g, count)


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
