"""Provide the views for training and measuring levels: photos, or renders of the scene if there are none.

Viewpoints of renders lie in navigable space, outside of solid parts. Views to measure on are independent of those to
train on. Levels are chosen and trained by wide views: one costs little more than a narrow view and shows several times
as much, so that few parts of a scene are seen by only a few cameras. Some look at detail from near (half of those to
train by), wherever navigable space lies, so that a wrong space costs little. Outside of rooms a quarter of those to
train by have eyes close to what stops light, where a large Gaussian that is right from afar covers the picture. Scene
frame; OpenCV cameras. docs/design/019-levels.md and docs/design/141-eyes-close-by.md compare them.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, replace

import numpy as np

from gsvis.errors import SceneError
from gsvis.progress import Progress, silent
from gsvis.render.judges import find_judges
from gsvis.render.rasterizer import rasterize
from gsvis.scene.cameras import Cameras
from gsvis.scene.close_eyes import draw_close_eyes
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.view_sampling import ViewSampling
from gsvis.train.images import PosedImages, render_views
from gsvis.train.likeness import mean_psnr
from gsvis.train.photos import load_photos

__all__ = [
    "CHOOSING",
    "CLOSE",
    "NEAR",
    "NEAR_CHOOSING",
    "WIDE",
    "LevelViews",
    "draw_views",
    "load_photograph_views",
    "views_to_choose",
    "views_to_train",
]

NEAR = 0.5
"""Share of views to train by that look at detail from near."""

NEAR_CHOOSING = 1.0 / 6.0
"""Share of views to choose by that look at detail from near: each gained there is lost where eyes may be."""

CLOSE = 0.5
"""Share of the other views to train by, outside of rooms, whose eyes are close to something: `draw_close_eyes`."""

_CLOSE_STREAM = 5  # of the seed
_OTHER_SEED = 1_000_003  # added to the seed of near views, whose rule also judges levels with other seeds
_EVERY = 8  # one in this many photos is held out
CHOOSING = 4
"""Cameras for the choice of Gaussians, per camera to train on."""

WIDE = 120.0
"""Degrees: horizontal field of view of views to choose and to train by."""

STANDING = 0.5
"""Share of views to choose and to train by, in rooms, from the height of people who stand; the others are anywhere."""

_SMALLER = 2.0 / 3.0  # ratio of the side of a training view to that of a held-out view
_UNLIKE = 12.0  # dB; photos of a different scene or frame do not match better
_DARK = 1.0 / 255.0


@dataclass(frozen=True, eq=False)
class LevelViews:
    """Views and their source.

    Attributes:
        views: Images to train on.
        held_out: Images to measure on; None for none.
        cameras_from: Source of their cameras, in words.
        photographs: Whether the images are photos.
        choose_by: Cameras for choosing Gaussians; None uses the cameras of the images.
        remarks: Sentences for the user.
        space: Navigable space of renders; None for photos.
    """

    views: PosedImages
    held_out: PosedImages | None
    cameras_from: str
    photographs: bool
    choose_by: Cameras | None = None
    remarks: tuple[str, ...] = ()
    space: NavigableSpace | None = None


def draw_views(
    g: Gaussians,
    space: NavigableSpace,
    sampling: ViewSampling,
    held_out: int,
    *,
    progress: Progress = silent,
) -> LevelViews:
    """Render a scene from random cameras.

    Args:
        g: The scene.
        space: Allowed viewpoints.
        sampling: Size of held-out views, and the number of training views, which are smaller and wider. The next
            random stream gives the held-out views. The stream after it gives four times as many wide cameras for
            choosing Gaussians: a Gaussian that few of them see well is dropped first. `NEAR` and `NEAR_CHOOSING` of
            them look at detail instead, and `CLOSE` of the other training views, outside of rooms, have close eyes.
        held_out: Number of held-out cameras; 0 for none.
        progress: Called with stage "views".

    Raises:
        SceneError: If no viewpoint is found, or the views are empty.
    """
    asked = [views_to_train(sampling)]
    if held_out:
        asked.append(replace(sampling, count=held_out, stream=sampling.stream + 1))
    total = sum(each.count for each in asked)
    found: list[PosedImages] = []
    to_train, to_choose = _near_cameras(g, sampling)
    places = [each.cameras(g, space) for each in asked]
    places[0] = _mix(to_train, _mix(_close_cameras(g, space, sampling), places[0]))
    for cameras in places:

        def report(stage: str, done: int, of: int, before: int = sum(map(len, found))) -> None:
            """Report progress over all kinds of views."""
            if done or not before:
                progress(stage, before + done, total)

        found.append(render_views(g, cameras, progress=report))
    if float(found[0].images.max()) < _DARK:
        raise SceneError("views from inside the scene are empty; check the up axis")
    drawn = f"drawn at random where eyes may be ({space.rule})"
    choosing = views_to_choose(sampling)
    many = _mix(to_choose.resize(choosing.width, choosing.height), choosing.cameras(g, space))
    return LevelViews(found[0], found[1] if held_out else None, drawn, False, many, space=space)


def _near_cameras(g: Gaussians, sampling: ViewSampling) -> tuple[Cameras, Cameras]:
    """Return cameras near detail to train by and to choose by.

    They follow the rule of judge's eyes, with a seed of their own.
    """
    to_train = round(NEAR * sampling.count)
    count = to_train + round(NEAR_CHOOSING * CHOOSING * sampling.count)
    asked = replace(views_to_train(sampling), count=count, fov=sampling.fov, seed=sampling.seed + _OTHER_SEED)
    near = find_judges(g, asked).cameras
    return near[:to_train], near[to_train:]


def _close_cameras(g: Gaussians, space: NavigableSpace, sampling: ViewSampling) -> Cameras:
    """Return cameras to train by whose eyes are close to what stops light; none in rooms, or where nothing does.

    They are as narrow as held-out views. Rooms need all wide views: their mean fell with half of them.
    """
    small = views_to_train(sampling)
    count = 0 if space.kind.kind == "rooms" else round(CLOSE * sampling.count)
    rng = np.random.default_rng([sampling.seed, sampling.stream + _CLOSE_STREAM])
    eyes = draw_close_eyes(g, space, count, rng)
    return space.cameras_at(eyes, rng, width=small.width, height=small.height, fov=sampling.fov)


def _mix(near: Cameras, anywhere: Cameras) -> Cameras:
    """Return as many cameras as are given anywhere, the first of which are replaced by near ones, spread evenly."""
    if len(near) == 0:
        return anywhere
    rest = anywhere[min(len(near), len(anywhere)) :]
    places = np.concatenate([(np.arange(len(each)) + 0.5) / max(len(each), 1) for each in (near, rest)])
    order = np.argsort(places, kind="stable")[: len(anywhere)]
    viewmats = np.concatenate([near.viewmats, rest.viewmats])[order]
    Ks = np.concatenate([near.Ks, rest.Ks])[order]
    return Cameras(viewmats, Ks, anywhere.width, anywhere.height)


def views_to_train(sampling: ViewSampling) -> ViewSampling:
    """Return the sampling of training views, smaller and wider, from that of held-out views."""
    small = {name: max(round(_SMALLER * getattr(sampling, name)), 1) for name in ("width", "height")}
    return replace(sampling, fov=max(sampling.fov, WIDE), standing=STANDING, **small)


def views_to_choose(sampling: ViewSampling) -> ViewSampling:
    """Return the sampling of views for choosing Gaussians, wide and four times as many, from that of held-out views."""
    count = CHOOSING * sampling.count
    stream = sampling.stream + 2
    return replace(sampling, count=count, stream=stream, fov=max(sampling.fov, WIDE), standing=STANDING)


def load_photograph_views(
    g: Gaussians,
    photos: str | os.PathLike[str],
    size: tuple[int, int] | None = None,
    *,
    downscale: float | None = None,
    progress: Progress = silent,
) -> LevelViews:
    """Load photos of a scene: seven of eight for training, the eighth held out.

    Args:
        g: The scene, trained from the same reconstruction.
        photos: Folder of a COLMAP model or a `transforms.json` with its images.
        size: Pixels (width, height) to shrink them to; None keeps their size.
        downscale: Factor to shrink them by instead.
        progress: Called with stage "photos".

    Raises:
        GsvisError: If they cannot be read, or show nothing of the scene.
        ValueError: If the size is invalid.
    """
    read = load_photos(photos, size=size, downscale=downscale, progress=progress)
    views, held_out = read.views.split(_EVERY)
    remarks = list(read.remarks)
    wrong = "check that they show this scene, in its frame"
    for c in range(len(held_out)):
        if float(rasterize(g, held_out.cameras[c]).images.max()) >= _DARK:
            break
    else:
        raise SceneError(f"{os.fspath(photos)}: no camera of the photographs shows any of the scene: {wrong}")
    likeness = mean_psnr(g, held_out)
    if likeness < _UNLIKE:
        remarks.append(f"The scene is unlike the photographs ({likeness:.1f} dB): {wrong}")
    return LevelViews(views, held_out, "photographs", True, remarks=tuple(remarks))
