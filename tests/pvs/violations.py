"""How often a bound may fail in repeated trials. By `scipy.special`: importing `scipy.stats` takes a second."""

from __future__ import annotations

import numpy as np
from scipy.special import bdtr

__all__ = ["most_violations"]


def most_violations(trials: int, error: float = 0.05) -> int:
    """Return the most violations that are consistent with an error: one-sided binomial test, p > 0.01."""
    return int(np.searchsorted(bdtr(np.arange(trials + 1), trials, error), 0.99))
