"""Reference implementations of this room, short and slow: the oracle of the tests."""

from __future__ import annotations

from collections.abc import Sequence

from gsvis.pvs.bound import STAKES

__all__ = ["upper_bound_reference"]


def upper_bound_reference(part: Sequence[float], whole: Sequence[float], error: float, steps: int = 100_000) -> float:
    """Return the least of `steps` equal shares at which some capital has grown to 1 / error; 1 if there is none.

    Args:
        part: Samples in [0, whole].
        whole: Samples in [0, 1].
        error: Probability in (0, 1) that the bound is too low.
        steps: Number of shares that are tried, one after the other.
    """
    for step in range(steps):
        ratio = step / steps
        capital = 0.0
        for stake, share in STAKES:
            money = share
            for a, b in zip(part, whole, strict=True):
                money *= 1.0 - stake * (a - ratio * b) / (1.0 - ratio)
            capital += money
        if capital >= 1.0 / error:
            return ratio
    return 1.0
