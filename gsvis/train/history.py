"""Record the history of a training run: one record per measurement."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

__all__ = ["MOST_PSNR", "Record"]

MOST_PSNR = 100.0
"""PSNR used for identical images, dB; the true value is infinite, which JSON cannot hold."""


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

    def as_json(self) -> dict[str, Any]:
        """Return the state without its time, ready for JSON: None for not measured, 100 dB for identical images."""
        loss = self.loss if math.isfinite(self.loss) else None
        psnr = None if math.isnan(self.psnr) else min(self.psnr, MOST_PSNR)
        return {"step": self.step, "loss": loss, "count": self.count, "psnr": psnr}
