"""Scenes, cameras and numbers of the comparison of levels: where training looks, where it is judged, and how.

Images are judged as a display shows them, clipped to [0, 1]. Numbers are kept in a folder by the content of what was
drawn and of what it was compared with, as FLIP takes seconds an image.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from _harness import realdata
from _rivals import digest
from numpy.typing import NDArray

from gsvis.io import load_scene
from gsvis.render import flip, psnr, rasterize, ssim, view_weights
from gsvis.scene._placement import Floors
from gsvis.scene.cameras import Cameras
from gsvis.scene.content import scene_hash
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.view_sampling import ViewSampling
from gsvis.train.photos import load_photos

__all__ = ["Case", "Numbers", "bonsai", "drawn", "showroom", "standing_cameras", "summed_weights"]

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

SIZE: dict[str, Any] = {"width": 480, "height": 360, "fov": float(2.0 * np.degrees(np.arctan(0.8)))}  # 300 px focal
EYE_HEIGHT = 1.6
TRAIN_SEED, HELD_OUT_SEED = 7, 99
HELD_OUT = 16
PHOTO_SIZE = 400, 266
_CHUNK = 16  # views whose weights are held at a time


@dataclass(frozen=True, eq=False)
class Case:
    """A scene, the cameras that levels are made for, and those that judge them.

    Attributes:
        name: Of the scene.
        scene: The full scene.
        train: Cameras of training; weights are summed over them.
        held_out: C other cameras.
        target: (C, H, W, 3) what they should show, in [0, 1].
        against: What the target is, in words.
    """

    name: str
    scene: Gaussians
    train: Cameras
    held_out: Cameras
    target: F32
    against: str


def showroom(train: int, seed: int = TRAIN_SEED, anywhere: bool = False) -> Case:
    """Showroom LOD 3, judged against renders of itself at standing height.

    Args:
        train: Number of training cameras.
        seed: Theirs.
        anywhere: Whether they are drawn as `gsvis levels --views --seed` draws them, instead of at standing height.
    """
    g = load_scene(realdata() / "scenes/showroom/lod-meta.json", lod=3)
    space = NavigableSpace.from_scene(g, up="+z")
    held_out = standing_cameras(space, HELD_OUT, HELD_OUT_SEED)
    if anywhere:
        cameras = ViewSampling(train, **SIZE, seed=seed).cameras(g, space)
    else:
        cameras = standing_cameras(space, train, seed)
    return Case("showroom", g, cameras, held_out, drawn(g, held_out), "the full scene")


def bonsai(scene: Path, photos: Path | None) -> Case:
    """A trained bonsai, judged against every 8th photograph."""
    views = load_photos(photos or realdata() / "photos/bonsai", size=PHOTO_SIZE).views
    train, held_out = views.split(every=8)
    target = np.stack([held_out.image(i) for i in range(len(held_out))])
    return Case("bonsai", load_scene(scene), train.cameras, held_out.cameras, target, "the photographs held out")


def standing_cameras(space: NavigableSpace, count: int, seed: int) -> Cameras:
    """Cameras of 480 x 360 at eyes 1.6 above the main floor, to within 10%, in scenes whose unit is a meter."""
    rng = np.random.default_rng(seed)
    eyes = space.sample_viewpoints(64 * count + 4096, rng)
    standing = Floors.below(eyes, space).at_height(EYE_HEIGHT, 1.0)
    assert standing is not None
    if standing.sum() < count:
        raise SystemExit(f"expected {count} places to stand, got {standing.sum()}")
    return space.cameras_at(eyes[standing][:count], rng, **SIZE)


def drawn(g: Gaussians, cameras: Cameras) -> F32:
    """(C, H, W, 3) images as a display shows them."""
    images: F32 = rasterize(g, cameras).images
    return images.clip(0.0, 1.0)


def summed_weights(case: Case, cache: Path) -> F64:
    """(N,) blending weight of each Gaussian, summed over the pixels of all training cameras."""
    kept = cache / f"weights-{scene_hash(case.scene)[:16]}-{digest(case.train.viewmats, case.train.Ks)}.npy"
    if kept.exists():
        return np.asarray(np.load(kept), np.float64)
    total = np.zeros(len(case.scene))
    for start in range(0, len(case.train), _CHUNK):
        total += view_weights(case.scene, case.train[start : start + _CHUNK]).summed.sum(axis=0, dtype=np.float64)
        print(f"weights: {start} of {len(case.train)} views", file=sys.stderr, flush=True)
    np.save(kept, total)
    return total


class Numbers:
    """How near images come to the target of a case; what was found once is read again."""

    def __init__(self, case: Case, cache: Path) -> None:
        self.case, self.cache = case, cache
        self._of_case = digest(case.target, case.held_out.viewmats, case.held_out.Ks)
        self.brightness = float(case.target.mean())

    def of(self, key: str, images: Callable[[], tuple[int, F32]]) -> dict[str, Any]:
        """PSNR, SSIM, FLIP and brightness.

        Args:
            key: Names what is drawn, for the cache.
            images: Gives the number of Gaussians and the (C, H, W, 3) images in [0, 1]; called if nothing is kept.
        """
        kept = self.cache / f"numbers-{self._of_case}-{key}.json"
        if kept.exists():
            found: dict[str, Any] = json.loads(kept.read_text(encoding="utf-8"))
            return found
        count, shown = images()
        target = self.case.target
        each = np.asarray(psnr(shown, target))
        found = {
            "count": count,
            "psnr": float(each.mean()),
            "worst_psnr": float(each.min()),
            "ssim": float(np.mean(ssim(shown, target))),
            "flip": float(np.mean(flip(shown, target))),
            "brightness": float(shown.mean()),
            "each_psnr": [round(float(value), 3) for value in each],
        }
        kept.write_text(json.dumps(found), encoding="utf-8")
        return found
