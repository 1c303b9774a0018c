"""Find which way is up in a scene: what its file states, else the likely axis of its Gaussians, with a confidence.

Frame and units are the scene's own. This module knows no command and no file.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gsvis.scene.gaussians import Gaussians
from gsvis.scene.inspection import axis_vector, guess_up

__all__ = ["SURE", "Upright", "find_up"]

F64 = NDArray[np.float64]

SURE = 0.8
"""Least confidence at which a guess is acted on without a word."""


@dataclass(frozen=True, eq=False)
class Upright:
    """Which way is up, and why.

    Attributes:
        up: (3,) unit up axis, scene frame; any direction.
        confidence: In (0, 1]; 1 for what is stated or given.
        reason: Where it comes from, in a line.
    """

    up: F64
    confidence: float
    reason: str

    @property
    def sure(self) -> bool:
        """Whether the confidence is high enough to act on it without a word."""
        return self.confidence >= SURE


def find_up(g: Gaussians) -> Upright:
    """Return the up axis of a scene: the stated one, else the likely one.

    Args:
        g: The scene; its facts are read first.
    """
    if g.facts.up is not None:
        return Upright(np.array(g.facts.up), 1.0, f"stated by {g.facts.up_source or 'the file'}")
    axis, confidence = guess_up(g)
    return Upright(axis_vector(axis), confidence, "the likely axis of the Gaussians")
