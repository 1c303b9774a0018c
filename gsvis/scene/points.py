"""Define a cloud of colored points: the result of a reconstruction and the start of training.

World frame and units are the scene's own; colors are sRGB as displayed, 0 black, 1 white. This module knows no file.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis import _check

__all__ = ["PointCloud"]

F32 = NDArray[np.float32]


@dataclass(frozen=True, init=False, eq=False, repr=False)
class PointCloud:
    """N colored points, validated, read-only.

    Contiguous float32 arrays are used without a copy: do not write to them afterward.

    Args:
        means: (N, 3) positions, scene units.
        colors: (N, 3) sRGB, 0 black to 1 white; None makes every point mid-gray.

    Raises:
        ValueError: If a shape, a length or a value is out of range; the message names the argument.

    Examples:
        >>> cloud = PointCloud([[0, 0, 0], [1, 2, 3]], [[1, 0, 0], [0, 0, 1]])
        >>> cloud[1:].colors.tolist()
        [[0.0, 0.0, 1.0]]
    """

    means: F32
    colors: F32

    def __init__(self, means: ArrayLike, colors: ArrayLike | None = None) -> None:
        positions = _check.floats("means", means, ("N", 3))
        gray = np.full(positions.shape, 0.5, np.float32)
        shades = gray if colors is None else _check.floats("colors", colors, ("N", 3))
        _check.same_length(means=positions, colors=shades)
        _check.in_range("colors", shades, 0.0, 1.0)
        for name, array in (("means", positions), ("colors", shades)):
            view = array.view()
            view.flags.writeable = False
            object.__setattr__(self, name, view)

    def __len__(self) -> int:
        return len(self.means)

    def __getitem__(self, index: Any) -> PointCloud:
        """Select points by a slice, a boolean mask, an index array, or one integer (a cloud of one)."""
        where = np.arange(len(self))[index].reshape(-1)
        return PointCloud(self.means[where], self.colors[where])

    def __repr__(self) -> str:
        return f"PointCloud({len(self):,})"
