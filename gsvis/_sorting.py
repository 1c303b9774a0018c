"""Order values by a fast sort, equal ones by their index.

numpy's stable sort takes three to six times as long as its vectorized one, which leaves equal values in any order.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["stable_order"]


def stable_order(values: NDArray[Any]) -> NDArray[np.int64]:
    """Return the order of values (N,), as `np.argsort(values, kind="stable")` does; fast if few are equal.

    Args:
        values: Numbers without NaN.
    """
    order = np.argsort(values)
    ranked = values[order]
    equal = ranked[1:] == ranked[:-1]
    if equal.any():
        tied = np.flatnonzero(np.append(equal, False) | np.append(False, equal))
        first = len(order) * np.cumsum(np.append(False, ~equal))[tied]  # the same for equal values, and ascending
        order[tied] = np.sort(first + order[tied]) - first
    return order
