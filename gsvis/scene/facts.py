"""Store what is known of a scene besides its Gaussians: its origin, its up axis, its units, how it was filtered.

Readers fill the facts from what a file states, writers put them into the next file, commands read them before they
guess. This module knows no file format and guesses nothing.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = ["SceneFacts"]

F64 = NDArray[np.float64]
Triple = tuple[float, float, float]

_ORIGIN: Triple = (0.0, 0.0, 0.0)


@dataclass(frozen=True, kw_only=True)
class SceneFacts:
    """State what a file or a user says of a scene. Facts that are not stated keep their defaults.

    Args:
        origin: Where the scene's (0, 0, 0) lies in the coordinates of its source, source units, in double precision.
            A center in the source is `origin + mean`.
        up: Unit up axis in the scene's frame; None if nothing states it.
        up_source: What states the up axis, such as "comment Vertical Axis"; empty if nothing does.
        antialiased: Whether the scene was trained with the opacity compensation of antialiased splatting.
        meters_per_unit: Meters in a scene unit; None if nothing states it.
        box: Lowest and highest corner of the box where eyes may be, scene frame; None if nothing states it.
    """

    origin: Triple = _ORIGIN
    up: Triple | None = None
    up_source: str = ""
    antialiased: bool = False
    meters_per_unit: float | None = None
    box: tuple[Triple, Triple] | None = None

    def transform(self, rotation: ArrayLike, scale: float) -> SceneFacts:
        """Return the facts after the scene is turned and scaled about its own (0, 0, 0).

        The origin is turned and scaled too, so that `origin + mean` moves as one; a translation is added by the caller.

        Args:
            rotation: (3, 3) rotation, new frame from old frame.
            scale: New units per old unit, > 0.
        """
        turn = np.asarray(rotation, np.float64)
        meters = self.meters_per_unit
        return replace(
            self,
            origin=_triple(scale * (turn @ np.asarray(self.origin))),
            up=None if self.up is None else _triple(turn @ np.asarray(self.up)),
            meters_per_unit=None if meters is None else meters / scale,
            box=None,
        )


def _triple(values: F64) -> Triple:
    x, y, z = (float(value) for value in values)
    return x, y, z
