"""The active terms of the cells of a package (equation 7 of the paper), computed cell by cell on request."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gsvis.color.activation import Activation
from gsvis.color.srbf import SrbfColors
from gsvis.pvs.store import VisibilityStore
from gsvis.scene.gaussians import Gaussians

__all__ = ["CellTerms"]


class CellTerms:
    """Computes the terms that an eye in a cell may need, of the Gaussians that the cell sees. Threads may share it.

    Args:
        g: N Gaussians.
        colors: Their colors, T terms.
        sets: Their visible sets.
        epsilon: Contribution above which a term is active, >= 0.

    Raises:
        ValueError: If lengths differ or epsilon is out of range.
    """

    def __init__(self, g: Gaussians, colors: SrbfColors, sets: VisibilityStore, epsilon: float) -> None:
        self._activation = Activation(colors, g.means, epsilon)
        self._sets = sets

    @property
    def epsilon(self) -> float:
        """Contribution above which a term is active."""
        return self._activation.epsilon

    def __len__(self) -> int:
        """Return C, the number of cells."""
        return len(self._sets)

    def active_ids(self, cell: int) -> NDArray[np.int64]:
        """Return the ids (A,) of the terms that an eye in a cell may need, ascending.

        Raises:
            ValueError: If there is no such cell.
            FormatError: If the visible sets are damaged there.
        """
        ids = self._sets.visible_ids(cell)
        return np.flatnonzero(self._activation.active_in_box(*self._sets.grid.bounds(cell), ids))
