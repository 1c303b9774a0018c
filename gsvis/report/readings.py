"""Show where people stand: one picture of the first view and of a plan with eyes, for every reading of the scene.

A scene in doubt has several readings: what it is, and which way is up. Scene frame and units.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from gsvis.errors import SceneError
from gsvis.prepare.start_views import choose_start_views
from gsvis.report.places import Places, Reading, draw_places
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.place import Place
from gsvis.scene.readings import find_choices
from gsvis.scene.source import Source

if TYPE_CHECKING:
    from gsvis.scene.cameras import Cameras
    from gsvis.scene.gaussians import Gaussians

__all__ = ["picture_of"]

_DRAWN = 12  # views that the first one is chosen from, as in `gsvis view`
_PICTURED = 1_000_000  # Gaussians that pictures show, at most
_RESOLUTION = 96  # voxels along the longest side, for the eyes of a reading


def picture_of(source: Source, place: Place, title: str = "", *, backend: str = "auto") -> bytes:
    """Return the picture as PNG bytes: a few seconds for any scene, since large ones are thinned.

    Args:
        source: The scene.
        place: Where eyes may be; it has a space.
        title: Title; the name of the scene by default.
        backend: Backend that draws the first views, see `DeviceScene`.
    """
    assert place.space is not None
    some = source.thin().gaussians
    choices = find_choices(place)
    readings = []
    for choice in choices:
        space = place.space
        if len(choices) > 1:
            try:
                space = NavigableSpace.of_kind(some, choice.kind, resolution=_RESOLUTION, up=choice.up)
            except (SceneError, ValueError):  # no eye fits, read like this
                continue
        readings.append(Reading(str(choice), space, _first_view(some, space)))
    if not readings:
        readings = [Reading(str(choices[0]), place.space, _first_view(some, place.space))]
    none = np.zeros((0, 3))
    shown = Places(
        title=title or f"{source.name}: where people stand",
        lines=tuple(_lines(place)),
        readings=tuple(readings),
        space=place.space,
        cameras=none if place.cameras is None else place.cameras.viewpoints,
        walk=none if place.path is None else place.path.positions,
    )
    return draw_places(source.thin(_PICTURED).gaussians, shown, backend=backend)


def _lines(place: Place) -> list[str]:
    """Return what decided, and what is doubtful."""
    assert place.space is not None
    kind = place.space.kind
    if kind.kind == "given":
        found = [f"Eyes: {kind.reason}."]
    elif place.evidence is None:
        found = [f"Taken for {kind}."]
    else:
        found = [f"Taken for {kind}; {place.evidence.confidence:.0%} sure."]
    if place.upright is not None:
        found.append(f"Up is {place.upright}.")
    return [*found, place.doubt] if place.doubt else found


def _first_view(some: Gaussians, space: NavigableSpace) -> Cameras | None:
    """Return the view that a visit begins with; None if no eye finds one."""
    return choose_start_views(some, space, 1, drawn=_DRAWN)
