"""Colors of places and directions from a hash grid and a small network.

Each level is a grid over the contracted scene whose corners are hashed into a table of features; a place has the
trilinear mean of its eight corners. The network takes the features of all levels and the direction.

References:
    Müller et al., "Instant neural graphics primitives with a multiresolution hash encoding", TOG 2022, section 3.
    Barron et al., "Mip-NeRF 360", CVPR 2022, equation 10, the contraction of far places.
"""

from __future__ import annotations

import itertools

import numpy as np
import torch
from torch import Tensor, nn

from arena.bags import sum_rows

__all__ = ["HashColors", "contract"]

_LEVELS = 6
_COARSEST = 16
_FINEST = 512
_TABLE = 1 << 13
_FEATURES = 2
_HIDDEN = 64
_PRIMES = (1, 2_654_435_761, 805_459_861)


class HashColors(nn.Module):
    """Colors as a function of a place and a direction.

    Args:
        middle: (3,) middle of the scene.
        size: Distance from it within which places are not contracted.
    """

    def __init__(self, middle: Tensor, size: float) -> None:
        super().__init__()
        torch.manual_seed(0)
        self.middle = middle
        self.size = size
        self.tables = nn.Parameter(2e-4 * torch.rand(_LEVELS, _TABLE, _FEATURES) - 1e-4)
        self.network = nn.Sequential(
            nn.Linear(_LEVELS * _FEATURES + 3, _HIDDEN), nn.ReLU(), nn.Linear(_HIDDEN, 3), nn.Sigmoid()
        )
        self.sides = np.rint(np.geomspace(_COARSEST, _FINEST, _LEVELS)).astype(int).tolist()

    def corners(self, places: Tensor) -> tuple[Tensor, Tensor]:
        """Return the entries around places (N, 3) in each table, and their trilinear weights, (levels, N, 8) each."""
        unit = 0.25 * contract((places - self.middle) / self.size) + 0.5
        found = [_corners(unit * side) for side in self.sides]
        return torch.stack([entries for entries, _ in found]), torch.stack([weights for _, weights in found])

    def forward(self, entries: Tensor, weights: Tensor, directions: Tensor) -> Tensor:
        """Return (N, 3) colors in [0, 1] of places, given by their corners, seen along unit directions (N, 3)."""
        features = [sum_rows(self.tables[level], entries[level], weights[level]) for level in range(_LEVELS)]
        colors: Tensor = self.network(torch.cat([*features, directions], dim=1))
        return colors


def _corners(at: Tensor) -> tuple[Tensor, Tensor]:
    """Return entries and weights, (N, 8) each, of the corners around places in units of a grid."""
    low = at.floor()
    part = at - low
    cell = low.long()
    entries, weights = [], []
    for corner in itertools.product((0, 1), repeat=3):
        weight = torch.ones(len(at))
        hashed = torch.zeros(len(at), dtype=torch.int64)
        for axis, step in enumerate(corner):
            weight = weight * (part[:, axis] if step else 1.0 - part[:, axis])
            hashed ^= (cell[:, axis] + step) * _PRIMES[axis]
        entries.append(hashed % _TABLE)
        weights.append(weight)
    return torch.stack(entries, dim=1), torch.stack(weights, dim=1)


def contract(places: Tensor) -> Tensor:
    """Return places (N, 3) within a ball of radius 2: those beyond 1 move to 2 - 1 / distance."""
    distance = places.norm(dim=1, keepdim=True).clamp(min=1e-9)
    return torch.where(distance <= 1.0, places, (2.0 - 1.0 / distance) * places / distance)
