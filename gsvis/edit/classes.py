"""Sort removable Gaussians into classes, by the evidence. This module renders and traces nothing.

A Gaussian has at most one class, the first that fits:

- flyaways: the center lies outside 5 times the robust box, and few others there make no backdrop.
- interior: no eye sees it, and it lies in something closed: no open air reaches the voxels around it.
- unseen: no eye sees it.
- fog: large and faint, and in the air through which eyes see.
- floaters: small, alone in that air, and seen from few directions.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gsvis import _check
from gsvis.edit.evidence import Evidence
from gsvis.edit.shape import RESOLUTION

__all__ = ["CLASSES", "HIDDEN", "KEPT", "CleanConfig", "class_of", "classify"]

U8 = NDArray[np.uint8]

KEPT = 0
"""Number of the Gaussians that stay."""

CLASSES = ("flyaways", "interior", "unseen", "fog", "floaters")
"""Names of the classes; class k + 1 has the name CLASSES[k]."""

HIDDEN = ("flyaways", "interior", "unseen")
"""Classes that no picture from navigable space should show."""

# least share of the mass in air, at strength 1
_FOG_SHARE = 0.35
_FLOATER_SHARE = 0.75
_FOG_OPACITY = 0.3  # most opacity of fog, at strength 1
_FACES = 40  # most of the 80 directions from which a floater is seen, at strength 1


@dataclass(frozen=True, kw_only=True)
class CleanConfig:
    """Options of a cleaning.

    Attributes:
        classes: Names of the classes that may go, from `CLASSES`.
        strength: How readily fog and floaters are found, in (0, 2]; 1 is the default.
        eyes: Number of viewpoints in navigable space, at least 1.
        size: Pixels along a side of the six faces around a viewpoint.
        resolution: Voxels along the longest side of the grid in which air is found, 8 to 4096; fewer where
            the grid would hold more than 16 million.
        held_out: Number of views that the guard renders; 0 for no guard.
        least_db: PSNR in dB that each held-out view must keep when classes of `HIDDEN` go.
        most_changed: Share of held-out pixels, in [0, 1], in which removed fog or floaters may make up more than half.
        tau: Least weight of a visible Gaussian, in (0, 0.5].
        seed: Seed of eyes and views.

    Raises:
        ValueError: If a value is out of range.
    """

    classes: tuple[str, ...] = CLASSES
    strength: float = 1.0
    eyes: int = 40
    size: int = 128
    resolution: int = RESOLUTION
    held_out: int = 8
    least_db: float = 45.0
    most_changed: float = 0.1
    tau: float = 1.0 / 255.0
    seed: int = 0

    def __post_init__(self) -> None:
        for name in self.classes:
            _check.one_of("classes", name, CLASSES)
        if not self.classes:
            raise ValueError(f"classes: expected at least one of {', '.join(CLASSES)}, got none")
        if not 0.0 < self.strength <= 2.0:
            raise ValueError(f"strength: expected a number in (0, 2], got {self.strength!r}")
        for name, least in (("eyes", 1), ("size", 4), ("held_out", 0), ("seed", 0)):
            _check.positive_int(name, getattr(self, name), at_least=least)
        if not 0.0 < self.tau <= 0.5:
            raise ValueError(f"tau: expected a weight in (0, 0.5], got {self.tau!r}")
        if not self.least_db >= 0.0:
            raise ValueError(f"least_db: expected at least 0 dB, got {self.least_db!r}")
        if not 0.0 <= self.most_changed <= 1.0:
            raise ValueError(f"most_changed: expected a share in [0, 1], got {self.most_changed!r}")


def class_of(name: str) -> int:
    """Return the number of a class.

    Raises:
        ValueError: If no class has that name.
    """
    return 1 + CLASSES.index(_check.one_of("class", name, CLASSES))


def classify(found: Evidence, config: CleanConfig) -> U8:
    """Return (N,) uint8, the class of each Gaussian; 0 for Gaussians that stay.

    Args:
        found: The evidence.
        config: The classes and the strength. A higher strength never finds fewer Gaussians.
    """
    s = config.strength
    fog_share = 1.0 - (1.0 - _FOG_SHARE) * min(s, 1.5)
    floater_share = 1.0 - (1.0 - _FLOATER_SHARE) * s
    unseen = ~found.seen & ~found.far
    misty = found.seen & found.large & (found.opacities <= min(1.0, _FOG_OPACITY * s)) & (found.air >= fog_share)
    alone = found.seen & ~found.large & found.alone & (found.air >= floater_share) & (found.faces <= _FACES * s)
    facts = {
        "flyaways": found.far & ~found.backdrop,
        "interior": unseen & found.enclosed,
        "unseen": unseen,
        "fog": misty & ~found.far,
        "floaters": alone & ~found.far,
    }
    classes = np.zeros(len(found.seen), np.uint8)
    for name, fact in facts.items():
        classes[(classes == KEPT) & fact] = class_of(name)
    return np.where(np.isin(classes, [class_of(name) for name in config.classes]), classes, np.uint8(KEPT))
