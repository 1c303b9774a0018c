"""The ways to read a scene in doubt that a user can choose from: what it is, and which way is up. Scene frame."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from gsvis.scene.axes import describe_direction, tilt_of
from gsvis.scene.kinds import SURE, Kind
from gsvis.scene.place import Place

__all__ = ["Choice", "find_choices"]

_CALLED: dict[Kind, str] = {"object": "an object", "rooms": "rooms", "open place": "an open place", "given": ""}
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
        return f"{called}{', ' if called else ''}up {_brief_direction(self.up)}"


def _brief_direction(up: NDArray[np.float64]) -> str:
    """Return a direction in few words: the name of an axis, or the vector."""
    text = describe_direction(up)
    return text.rpartition(", ")[0] or text


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
