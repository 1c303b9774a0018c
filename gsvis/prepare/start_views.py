"""Choose start views for visitors: upright, from where a person may stand, and with much to see.

An object is whole in the picture, from several sides, and views aim at its middle. In rooms eyes stand where people
stand, away from walls, and look where there is most room. In an open place the first views aim at its detail. Of all
such views those are taken that show most Gaussians and have least right in front of the eye. Scene frame; OpenCV
cameras.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gsvis.errors import SceneError
from gsvis.jobs.in_order import in_order
from gsvis.render import view_weights
from gsvis.render.weights import ColorsOf, draw_and_weigh
from gsvis.scene.cameras import Cameras
from gsvis.scene.core import Core, find_core
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.poses import describe_poses
from gsvis.scene.view_sampling import ViewSampling

__all__ = ["START_VIEWS", "choose_start_views", "describe_start_views", "shows_object"]

F64 = NDArray[np.float64]

START_VIEWS = 5
"""Number of views of a package."""

_SAMPLING = ViewSampling(48, 96, 72, 80.0, stream=4)
_LEVEL = 0.35  # greatest slope of a view, as the sine of its angle with the ground
_STANDING = 0.58  # height of an eye between floor and ceiling
_SEEN = 0.25  # least summed weight, pixels, of a Gaussian that counts
_APART = 0.1  # least distance between the eyes of two views, in the diagonal of all
_COVERAGE = 0.995  # share of the centers of an object that its box holds on each axis
_SIDES = 12  # around an object
_SIDES_APART = 0.3  # the same around an object: about 60 degrees
_TILTS = (10.0, 25.0)  # degrees above the middle of an object
_STEEP = 60.0  # the same, of a thing that lies flat
_FLAT = 0.3  # height of such a thing in its longest side
_FRAME = 0.85 * np.tan(np.radians(30.0))  # half of a picture that an object fills, for a field of view of 60 degrees
_TURNS = 16  # level directions in which room is looked for
_WALLED = 0.75  # least share of these that end at something, in rooms
_CLEAR = 0.6  # least free part of the way from an eye to the middle of the detail
_TRIED = 12  # lowest eyes of those that see it
_MORE = 240  # eyes that are tried for that
_NEAR = 0.2  # what is nearer than this, in the distance to what is looked at, is in the way
_IN_THE_WAY = 4.0  # how much more it counts than what is seen


def choose_start_views(
    scene: Gaussians, space: NavigableSpace, count: int = START_VIEWS, *, drawn: int = 48, seed: int = 0
) -> Cameras | None:
    """Return the views of a scene that show most, the best first; None if none is found.

    Args:
        scene: The scene.
        space: Allowed viewpoints.
        count: Largest number of views.
        drawn: Number of cameras to choose from.
        seed: Seed of the random numbers.
    """
    return _choose(scene, space, _Subject.of(scene, space), count, drawn, seed, None)


def _choose(
    scene: Gaussians,
    space: NavigableSpace,
    subject: _Subject,
    count: int,
    drawn: int,
    seed: int,
    colors_of: ColorsOf | None,
) -> Cameras | None:
    """Return what `choose_start_views` returns, for a known subject."""
    favored = 0
    if subject.is_object:
        cameras = _around(subject, space)
    else:
        try:
            cameras = replace(_SAMPLING, count=drawn, seed=seed).cameras(scene, space)
        except SceneError:
            return None
        cameras, favored = _within(subject, space, cameras)
    worth = _worth(scene, space, subject, cameras, colors_of)
    if favored:
        worth[np.argmax(worth[:favored])] = np.inf  # one view of the detail comes first
    eyes = cameras.viewpoints
    apart = (_SIDES_APART if subject.is_object else _APART) * float(np.linalg.norm(np.ptp(eyes, axis=0)))
    chosen: list[int] = []
    for k in np.argsort(-worth, kind="stable").tolist():
        if len(chosen) < count and all(np.linalg.norm(eyes[k] - eyes[other]) >= apart for other in chosen):
            chosen.append(k)
    return cameras[chosen]


def _pivot_distances(subject: _Subject, space: NavigableSpace, cameras: Cameras) -> F64:
    """Return (C,) how far ahead lies what each camera looks at: the middle of an object, else the first surface.

    Where nothing solid is ahead, it is the point nearest to the middle of the scene's detail.

    Args:
        subject: What the scene shows.
        space: Where eyes may be.
        cameras: The cameras.
    """
    eyes = cameras.viewpoints
    to_middle = np.einsum("ci,ci->c", subject.middle - eyes, cameras.forwards)
    distances = np.asarray(np.maximum(to_middle, 0.1 * float(subject.sides.max())), np.float64)
    if subject.is_object:
        return distances
    ahead = space.free_distances(eyes, cameras.forwards)
    return np.asarray(np.where(np.isfinite(ahead), ahead, distances), np.float64)


def describe_start_views(
    scene: Gaussians,
    space: NavigableSpace,
    count: int = START_VIEWS,
    *,
    drawn: int = 48,
    seed: int = 0,
    colors_of: ColorsOf | None = None,
) -> list[dict[str, Any]]:
    """Return the start views of a scene as poses, each with its `reach`, the distance of the pivot; may be empty.

    Args:
        scene: The scene.
        space: Allowed viewpoints.
        count: Largest number of views.
        drawn: Number of cameras to choose from.
        seed: Seed of the random numbers.
        colors_of: Colors of the Gaussians in pictures of an object; None means their SH colors.
    """
    subject = _Subject.of(scene, space)
    cameras = _choose(scene, space, subject, count, drawn, seed, colors_of)
    if cameras is None:
        return []
    reaches = _pivot_distances(subject, space, cameras).tolist()
    poses = describe_poses(cameras)
    return [pose | {"reach": float(f"{reach:.6g}")} for pose, reach in zip(poses, reaches, strict=True)]


def shows_object(scene: Gaussians, space: NavigableSpace) -> bool:
    """Return whether a scene is an object, or may be one and has nothing around it."""
    return _is_object(space, find_core(scene))


def _is_object(space: NavigableSpace, core: Core) -> bool:
    """Return what `shows_object` returns, for a known core."""
    kind = space.kind
    return kind.kind == "object" or (kind.other == "object" and not core.has_surroundings)


class _Subject(NamedTuple):
    """What a scene shows: its detail, without what lies around it.

    Attributes:
        low: (3,) low corner of the box around it.
        high: (3,) high corner.
        center: (3,) center of the core of the scene.
        is_object: Whether it is an object, see `shows_object`.
    """

    low: F64
    high: F64
    center: F64
    is_object: bool

    @property
    def middle(self) -> F64:
        """The middle of the box (3,)."""
        return 0.5 * (self.low + self.high)

    @property
    def sides(self) -> F64:
        """The sides of the box (3,)."""
        return self.high - self.low

    @classmethod
    def of(cls, scene: Gaussians, space: NavigableSpace) -> _Subject:
        """Return the subject of a scene."""
        core = find_core(scene)
        wide = find_core(scene, _COVERAGE)
        box = (wide.detail_low, wide.detail_high) if wide.has_surroundings else (wide.low, wide.high)
        return cls(*box, core.center, _is_object(space, core))


def _around(subject: _Subject, space: NavigableSpace) -> Cameras:
    """Return cameras around an object that hold all of its box; those whose eyes lie in the space, if any do."""
    middle = subject.middle
    corners = np.stack([subject.low, subject.high], axis=1)
    ends = np.stack(np.meshgrid(*corners, indexing="ij"), axis=-1).reshape(-1, 3) - middle
    east = np.cross(space.up, np.eye(3)[np.abs(space.up).argmin()])
    east /= np.linalg.norm(east)
    north = np.cross(space.up, east)
    eyes = []
    sides = ends.max(axis=0)
    is_flat = float(np.abs(space.up) @ sides) < _FLAT * float(sides.max())
    for tilt in np.radians([*_TILTS, _STEEP] if is_flat else _TILTS):
        for turn in 2.0 * np.pi * np.arange(_SIDES) / _SIDES:
            away = np.cos(tilt) * (np.cos(turn) * east + np.sin(turn) * north) + np.sin(tilt) * space.up
            right = np.cross(away, space.up)
            right /= np.linalg.norm(right)
            wide = np.maximum(np.abs(ends @ right), np.abs(ends @ np.cross(right, away)))
            eyes.append(middle + float((wide / _FRAME + ends @ away).max()) * away)
    found = np.array(eyes)
    inside = space.contains(found)
    return _looking(found[inside] if inside.any() else found, middle, space)


def _within(subject: _Subject, space: NavigableSpace, drawn: Cameras) -> tuple[Cameras, int]:
    """Return level cameras at the eyes of drawn ones, and how many of the first look at the detail of an open place.

    In rooms all look to where most room is.
    """
    eyes = drawn.viewpoints
    if space.kind.kind != "rooms":
        eyes = np.concatenate([eyes, space.sample_viewpoints(_MORE, np.random.default_rng(len(eyes)))])
    eyes = _standing(eyes, space)
    east = np.cross(space.up, np.eye(3)[np.abs(space.up).argmin()])
    east /= np.linalg.norm(east)
    turns = 2.0 * np.pi * np.arange(_TURNS) / _TURNS
    ways = np.outer(np.cos(turns), east) + np.outer(np.sin(turns), np.cross(space.up, east))
    free = space.free_distances(np.repeat(eyes, _TURNS, axis=0), np.tile(ways, (len(eyes), 1)))
    free = free.reshape(-1, _TURNS)
    room = np.minimum(free, np.nanmax(np.where(np.isfinite(free), free, np.nan), initial=1.0))
    if space.kind.kind == "rooms" or np.isfinite(free).mean() >= _WALLED:
        walled = np.isfinite(free).mean(axis=1) >= _WALLED
        clear = room.min(axis=1) >= np.median(room.min(axis=1))
        some = walled & clear if (walled & clear).any() else np.ones(len(eyes), bool)
        eyes = eyes[some]
        wide = sum(np.roll(room[some], k, axis=1) for k in (-1, 0, 1))
        return _looking(eyes, eyes + ways[np.argmax(wide, axis=1)], space), 0
    middle = subject.center
    away = middle - eyes
    sight = np.linalg.norm(away, axis=1)
    below = space.free_distances(eyes, np.tile(-space.up, (len(eyes), 1)))
    clear = space.free_distances(eyes, away / sight[:, None]) >= _CLEAR * sight
    level = np.abs(away @ space.up) <= _LEVEL * sight
    apart = sight >= 0.3 * float(np.linalg.norm(subject.sides))
    good = np.flatnonzero(np.isfinite(below) & clear & level & apart)
    lowest = eyes[good[np.argsort(below[good], kind="stable")][:_TRIED]]
    others = drawn[np.flatnonzero(np.abs(drawn.forwards @ space.up) <= _LEVEL)]
    aims = np.concatenate([np.broadcast_to(middle, lowest.shape), others.viewpoints + others.forwards])
    return _looking(np.concatenate([lowest, others.viewpoints]), aims, space), len(lowest)


def _looking(eyes: F64, targets: F64, space: NavigableSpace) -> Cameras:
    """Return upright cameras at eyes (C, 3) that look at targets, as wide as those that are drawn."""
    aims = np.broadcast_to(targets, eyes.shape)
    return Cameras.look_at(eyes, aims, up=space.up, width=_SAMPLING.width, height=_SAMPLING.height, fov=_SAMPLING.fov)


def _worth(
    scene: Gaussians, space: NavigableSpace, subject: _Subject, cameras: Cameras, colors_of: ColorsOf | None
) -> F64:
    """Return (C,) how much each view shows, less for what is in the way: Gaussians, and of an object contrasts.

    The front of an object has no more Gaussians than its back, but more to look at.
    """
    distances = _pivot_distances(subject, space, cameras)
    eyes = cameras.viewpoints

    def worth(c: int) -> float:
        """Return how much one view shows."""
        if subject.is_object:
            image, summed = draw_and_weigh(scene, cameras[c], colors_of)
            brightness = image.mean(axis=2)
            shown = sum(float(np.abs(np.diff(brightness, axis=axis)).sum()) for axis in (0, 1))
        else:
            summed = view_weights(scene, cameras[c]).summed[0]
            shown = float(np.count_nonzero(summed >= _SEEN) * summed.sum())  # nobody looks into the void
        near = np.linalg.norm(scene.means - eyes[c], axis=1) < _NEAR * distances[c]
        blocked = float(summed[near].sum() / max(float(summed.sum()), 1e-9))
        return shown * max(0.0, 1.0 - _IN_THE_WAY * blocked)

    return np.array(list(in_order(worth, range(len(cameras)))))


def _standing(eyes: F64, space: NavigableSpace) -> F64:
    """Return eyes (C, 3), moved to the height of a standing person where there are a floor and a ceiling, if free."""
    below, above = (space.free_distances(eyes, np.tile(way, (len(eyes), 1))) for way in (-space.up, space.up))
    column = below + above
    rise = np.zeros(len(eyes))
    roofed = np.isfinite(column)
    rise[roofed] = _STANDING * column[roofed] - below[roofed]
    moved = eyes + rise[:, None] * space.up
    free = space.contains(moved)
    return moved[free] if free.any() else eyes
