"""How a training run went: one record for each time it was measured."""

from __future__ import annotations

import math
from dataclasses import dataclass

__all__ = ["Record"]


@dataclass(frozen=True)
class Record:
    """How training stood after a step.

    Attributes:
        step: Steps taken.
        seconds: Time spent in training so far, evaluation and checkpoints not counted.
        loss: Running mean over about the last hundred steps.
        count: Gaussians.
        psnr: Mean over held-out views of images clipped to [0, 1], dB; NaN where not measured.
    """

    step: int
    seconds: float
    loss: float
    count: int
    psnr: float = math.nan
