"""Record the history of a training run: one record per measurement."""

from __future__ import annotations

import math
from dataclasses import dataclass

__all__ = ["Record"]


@dataclass(frozen=True)
class Record:
    """State of training after a step.

    Attributes:
        step: Steps taken.
        seconds: Training time so far, without evaluation and checkpoints.
        loss: Running mean over about the last hundred steps.
        count: Number of Gaussians.
        psnr: Mean over held-out views of images clipped to [0, 1], dB; NaN if not measured.
    """

    step: int
    seconds: float
    loss: float
    count: int
    psnr: float = math.nan
