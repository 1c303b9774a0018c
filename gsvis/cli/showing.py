"""Show where people stand: one picture of the first view and of a plan with eyes, for every reading of the scene.

It is written where --show says; a dry run in doubt writes it beside where the output would go. Nothing is asked here;
see `gsvis.cli.asking`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from gsvis.cli.source import Source
from gsvis.cli.where import Place
from gsvis.errors import SceneError
from gsvis.scene.axes import describe_direction, tilt_of
from gsvis.scene.kinds import SURE, Kind
from gsvis.scene.navigable import NavigableSpace

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from gsvis.scene.cameras import Cameras
    from gsvis.scene.gaussians import Gaussians

__all__ = [
    "Choice",
    "brief_direction",
    "find_choices",
    "picture_of",
    "place_beside",
    "write_picture",
]

SUFFIX = ".where.png"
"""Added to the name of the output, for the picture that is written in doubt."""

_CALLED: dict[Kind, str] = {"object": "an object", "rooms": "rooms", "open place": "an open place", "given": ""}
_DRAWN = 12  # views that the first one is chosen from, as in `gsvis view`
_PICTURED = 1_000_000  # Gaussians that pictures show, at most
_RESOLUTION = 96  # voxels along the longest side, for the eyes of a reading
_SAME = 5.0  # degrees within which two up axes are one answer


@dataclass(frozen=True, eq=False)
class Choice:
    """One reading of a scene that a user can choose.

    Attributes:
        kind: What it is read as.
        up: (3,) unit up axis.
    """

    kind: Kind
    up: NDArray[np.float64]

    def __str__(self) -> str:
        called = _CALLED[self.kind]
        return f"{called}{', ' if called else ''}up {brief_direction(self.up)}"


def brief_direction(up: NDArray[np.float64]) -> str:
    """Return a direction in few words: the name of an axis, or the vector."""
    text = describe_direction(up)
    return text.rpartition(", ")[0] or text


def place_beside(out: str | None) -> Path | None:
    """Return the path of the picture that is written in doubt; None without an output."""
    if out is None:
        return None
    target = Path(out).absolute()
    folder = next(each for each in target.parents if each.is_dir())  # a dry run makes no folder
    beside = Path(out).parent if folder == target.parent else folder
    return beside / (target.name + SUFFIX)


def find_choices(place: Place) -> list[Choice]:
    """Return the readings of a scene, the likely one first; one if there is no doubt.

    The others differ from the first in what is doubtful: the kind, the up axis.

    Args:
        place: Where eyes may be, with a space and an up axis.
    """
    assert place.space is not None
    assert place.upright is not None
    kind = place.space.kind
    upright = place.upright
    choices = [Choice(kind.kind, place.space.up if upright.sure else upright.up)]
    if not place.doubt:
        return choices
    if place.evidence is not None and place.evidence.confidence < SURE and kind.other is not None:
        choices.append(replace(choices[0], kind=kind.other))
    if not upright.sure and upright.other is not None and tilt_of(upright.up, upright.other) > _SAME:
        choices.append(replace(choices[0], up=upright.other))
    return choices


def picture_of(source: Source, place: Place, title: str = "") -> bytes:
    """Return the picture as PNG bytes: a few seconds for any scene, since large ones are thinned.

    Args:
        source: The scene.
        place: Where eyes may be; it has a space.
        title: Title; the name of the scene by default.
    """
    from gsvis.report.places import Places, Reading, draw_places

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
    return draw_places(source.thin(_PICTURED).gaussians, shown)


def write_picture(path: Path, source: Source, place: Place) -> None:
    """Write the picture, complete or not at all.

    Raises:
        OutputError: If it cannot be written.
    """
    from gsvis.files.atomic import atomic_path

    png = picture_of(source, place)
    with atomic_path(path) as partial:
        partial.write_bytes(png)


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
    from gsvis.prepare.start_views import choose_start_views

    return choose_start_views(some, space, 1, drawn=_DRAWN)
