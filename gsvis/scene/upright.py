"""Find the up axis of a scene: the one that its file states, else that of cameras, else that of the Gaussians.

Up is any unit vector in the scene's frame, with a confidence. This module knows no command and no file.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis import _check
from gsvis.scene._up_cameras import level_cameras
from gsvis.scene._up_odds import Likely, find_likely
from gsvis.scene._up_sample import sample_surface
from gsvis.scene.axes import axis_vector, describe_direction, tilt_of
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians

__all__ = ["SURE", "Upright", "doubt_up", "find_up"]

F64 = NDArray[np.float64]

SURE = 0.8
"""Least confidence at which a guess is used without a warning."""

_NOTHING = 0.25  # confidence in the convention of most files, if nothing else is known
_CONTRADICTION = 40.0  # degrees
_likely: WeakKeyDictionary[Gaussians, Likely | None] = WeakKeyDictionary()  # a cache; scenes never change


@dataclass(frozen=True, eq=False)
class Upright:
    """The up axis of a scene, with reasons.

    Attributes:
        up: (3,) unit up axis, scene frame; any direction.
        confidence: In (0, 1]; 1 if it is stated or given.
        reason: The source of the axis, in a line.
        doubt: Evidence that clearly contradicts it, in a line; empty without any.
        other: (3,) the second likely axis, scene frame; None if there is none.
    """

    up: F64
    confidence: float
    reason: str
    doubt: str = ""
    other: F64 | None = None

    @property
    def sure(self) -> bool:
        """Whether the confidence is high enough to use the axis without a warning."""
        return self.confidence >= SURE

    def __str__(self) -> str:
        return f"{describe_direction(self.up)}, {self.confidence:.0%}: {self.reason}"


def find_up(g: Gaussians, *, cameras: Cameras | None = None, check: bool = True) -> Upright:
    """Return the up axis of a scene: the stated one, else that of cameras, else the likely one.

    A stated axis wins even if the scene clearly contradicts it; `doubt` then says so.

    Args:
        g: The scene; its facts are read first.
        cameras: Cameras that took its photos, in the scene's frame. People hold cameras level.
        check: Whether to look for evidence against the stated axis or the cameras.
    """
    if g.facts.up is not None:
        stated = np.array(g.facts.up)
        doubt = doubt_up(g, stated, cameras=cameras) if check else ""
        return Upright(stated, 1.0, f"stated by {g.facts.up_source or 'the file'}", doubt)
    level = level_cameras(cameras) if cameras is not None else None
    if level is not None and level.confidence >= SURE:
        return Upright(*level, doubt_up(g, level.up) if check else "")
    found = _from_gaussians(g)
    if level is None:
        return found
    if tilt_of(level.up, found.up) < _CONTRADICTION:  # cameras and Gaussians agree
        return Upright(level.up, 1.0 - (1.0 - level.confidence) * (1.0 - found.confidence), level.reason)
    if found.confidence > level.confidence:
        return replace(found, other=level.up)
    return Upright(*level, other=found.up)


def doubt_up(g: Gaussians, up: ArrayLike, *, cameras: Cameras | None = None) -> str:
    """Return evidence that clearly contradicts an up axis, in a line; empty without any.

    Cameras are tested first, then ground and walls. Uncertain evidence is ignored.

    Args:
        g: The scene; its facts are ignored.
        up: (3,) the axis in question, such as one that a user gives.
        cameras: Cameras that took its photos, in the scene's frame.
    """
    axis = _check.unit_vectors("up", np.reshape(np.asarray(up, np.float64), (1, -1)))[0]
    level = level_cameras(cameras) if cameras is not None else None
    if level is not None and level.confidence >= SURE and tilt_of(axis, level.up) > _CONTRADICTION:
        return _describe_contradiction(axis, level.up, "the cameras are")
    likely = _find_once(g)
    if likely is None or likely.geometry < SURE or tilt_of(axis, likely.up) <= _CONTRADICTION:
        return ""
    return _describe_contradiction(axis, likely.up, "ground and walls are" if likely.ground else "the object is")


def _describe_contradiction(axis: F64, other: F64, witness: str) -> str:
    """Return the line that says how evidence contradicts an axis."""
    angle = tilt_of(axis, other)
    how = "upside down" if angle > 140.0 else f"{angle:.0f} degrees off"
    return f"up is {describe_direction(axis)}, but {witness} level with {describe_direction(other)} up: {how}?"


def _find_once(g: Gaussians) -> Likely | None:
    """Return the likely up axis of a scene, cached; None if the scene has too few Gaussians."""
    if g not in _likely:
        sample = sample_surface(g)
        _likely[g] = find_likely(sample) if sample is not None else None
    return _likely[g]


def _from_gaussians(g: Gaussians) -> Upright:
    """Return the up axis from the Gaussians alone."""
    likely = _find_once(g)
    if likely is None:
        return Upright(axis_vector("-y"), _NOTHING, "what most files use; too few Gaussians to tell")
    other = None if likely.other is None else likely.other.copy()
    return Upright(likely.up.copy(), likely.confidence, _explain(likely), other=other)


def _explain(likely: Likely) -> str:
    """Return the reason why an axis is likely, in a line."""
    e = likely.evidence
    if likely.confidence < 0.5:
        return "there is little evidence for any up axis"
    if not likely.ground:
        return f"an object, {e.height:.1f} times as high as wide, {e.upright:.0%} of its surface upright"
    what = "floor and ceiling hold" if e.pair > 0.3 else "level ground holds"
    return f"{what} {e.slab:.0%} of the surface, {e.upright:.0%} is upright"
