"""Find navigable space in a scene of many places, such as flats along a street, parcel by parcel.

A grid over a whole scene resolves rooms only if they are many voxels wide. In a larger scene rooms appear closed, so
that eyes would only be above roofs or on the street. Therefore rooms and open ground are searched in each parcel with
its surroundings. If the grid over the whole scene already covers most of the space of parcels, it is used alone,
because it separates inside and outside better. Otherwise both are joined. A scene that looks like an object counts as
one only if most of its parcels do too.
Scene frame and units. docs/design/033-kinds-of-space.md.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from gsvis.edit.parcels import PARCEL, VOXELS, indoors, join_spaces, lay_parcels, mixed_space, rows_near
from gsvis.errors import SceneError
from gsvis.jobs.graph import Facts
from gsvis.progress import Progress, silent
from gsvis.scene.axes import nearest_axis
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.kinds import SpaceKind
from gsvis.scene.navigable import NavigableSpace
from gsvis.world.tiles import near_tile
from gsvis.world.tiling import sampling_interval, thin_out

__all__ = ["Parcel", "find_in_parcels", "is_well_known", "join_parcels", "parcels_of", "space_of_parcel"]

F64 = NDArray[np.float64]

Parcel = tuple[int, NavigableSpace | None]
"""The Gaussians of a parcel, and its navigable space."""

_SEEN = 0.75  # least share of the Gaussians that eyes in rooms see if the scene is only these rooms
_SHOWN = 0.25  # least share of the space of parcels that the whole has, for it to stay as it is
_NOTABLE = 0.05  # share of the space of parcels that is indoors, from which that has to be shown by itself
_HELD = 0.5  # least share of the Gaussians in parcels with a place, for an object to be none
_ALONE = 96  # voxels along the longest side of a parcel that may be an object


def is_well_known(space: NavigableSpace) -> bool:
    """Return whether the grid over a whole scene resolves it: it has rooms from which most Gaussians are seen."""
    found = space.kind
    return found.kind == "rooms" and found.evidence is not None and found.evidence.seen_within >= _SEEN


def find_in_parcels(
    core: Gaussians, whole: NavigableSpace, *, most: int = PARCEL, progress: Progress = silent
) -> NavigableSpace:
    """Return the navigable space of a scene, by its parcels if one grid does not resolve it.

    Args:
        core: The Gaussians that hide others.
        whole: Navigable space by a grid over the whole scene.
        most: Approximate number of Gaussians of a parcel.
        progress: Called with stage "space", in parcels.
    """
    every = sampling_interval(len(core))
    is_object = whole.kind.kind == "object"
    parcels = list[Parcel]()
    squares = parcels_of(whole, thin_out(core, every), every, nearest_axis(whole.up), most)
    for done, square in enumerate(squares):
        progress("space", done, len(squares))
        count = int(np.count_nonzero(near_tile(core.means, square, 0.0)))
        upright = {**square, "up": whole.up}
        parcels.append((count, space_of_parcel(rows_near([core], square), upright, is_object)))
    return join_parcels(whole, parcels)


def parcels_of(whole: NavigableSpace, sample: Gaussians, every: int, up: str, most: int = PARCEL) -> list[Facts]:
    """Return the parcels of a scene, see `lay_parcels`; none if the grid over the whole scene suffices.

    Args:
        whole: Navigable space by a grid over the whole scene.
        sample: One in `every` of its visible Gaussians.
        every: Number of Gaussians that one of the sample represents.
        up: Axis that points upward, such as "+z"; squares lie along axes.
        most: Approximate number of Gaussians of a parcel.
    """
    found = [] if is_well_known(whole) else lay_parcels(sample, every, up, most)
    return found if len(found) > 1 else []


def space_of_parcel(near: Gaussians, square: Facts, is_object: bool) -> NavigableSpace | None:
    """Return the navigable space of a parcel; None if there is none.

    Args:
        near: The Gaussians in and around it that hide others.
        square: The square of the parcel.
        is_object: Whether the whole scene looks like an object. Then a parcel that also does has no space.
    """
    if len(near) == 0:
        return None
    if is_object:
        try:
            alone = NavigableSpace.from_scene(near, resolution=_ALONE, up=square["up"])
        except SceneError:
            return None
        if alone.kind.kind == "object":
            return None
    side = max(b - a for a, b in zip(square["low"], square["high"], strict=True))
    return mixed_space(near, square, side / VOXELS)


def join_parcels(whole: NavigableSpace, parcels: Iterable[Parcel]) -> NavigableSpace:
    """Return the navigable space of a scene from a grid over it and its parcels; only the grid if it covers most.

    A notable indoor part must be covered separately, because a street is larger than the rooms beside it.

    Args:
        whole: The space of the scene.
        parcels: The space of each parcel within its squares; iterated over three times.
    """
    volumes = np.zeros(4)
    count = 0
    held = 0
    places = 0
    for gaussians, space in parcels:
        count += gaussians
        if space is not None:
            held = held + gaussians
            places = places + 1
            volumes += _volumes(space, whole)
    volume, shown, inside, inside_shown = volumes.tolist()
    if shown >= _SHOWN * volume and (inside < _NOTABLE * volume or inside_shown >= _SHOWN * inside):
        return whole
    if whole.kind.kind == "object" and held < _HELD * count:
        return whole
    return _join(whole, _Spaces(parcels), places)


def _volumes(parcel: NavigableSpace, whole: NavigableSpace) -> F64:
    """Return (4,) the volume of a parcel's space, its part in the space of the whole scene, and both indoors."""
    voxels = np.argwhere(parcel.free)
    inside = indoors(parcel)[parcel.free]
    shown = whole.contains(parcel.origin + parcel.voxel_size * (voxels + 0.5))
    counts = [len(voxels), np.count_nonzero(shown), np.count_nonzero(inside), np.count_nonzero(inside & shown)]
    return np.array(counts) * parcel.voxel_size**3


@dataclass(frozen=True)
class _Spaces:
    """The spaces of parcels that have one, read again at each iteration."""

    parcels: Iterable[Parcel]

    def __iter__(self) -> Iterator[NavigableSpace]:
        for _, space in self.parcels:
            if space is not None:
                yield space


def _join(whole: NavigableSpace, spaces: _Spaces, count: int) -> NavigableSpace:
    """Return the space of a scene joined with those of a number of its parcels."""
    places = f"in rooms and on open ground of {count} parcels of it"
    if whole.kind.kind == "object":  # the parcels show that it is not an object
        kind = SpaceKind("rooms", "many places", whole.kind.evidence, places)
        found = join_spaces(spaces)
        return replace(found, rule="by parcels", kind=kind, parcels=1 + found.parcels)
    kind = replace(whole.kind, eyes=f"{whole.kind.eyes}, and {places}")
    return replace(join_spaces(spaces, whole), rule=f"{whole.rule}; and by parcels", kind=kind)
