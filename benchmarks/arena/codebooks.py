"""Codebooks by weighted k-means, and quantization that gradients pass through.

References:
    Niedermayr et al., "Compressed 3D Gaussian Splatting for Accelerated Novel View Synthesis", CVPR 2024, section 4.1
    (the batches of its k-means) and 4.2 (quantization with straight-through gradients).
"""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = ["fake_quantize", "kmeans", "nearest", "quantize_ends"]

_BATCH = 1 << 14


def kmeans(rows: Tensor, weights: Tensor, count: int, rounds: int = 20, seed: int = 0) -> Tensor:
    """Return centers of rows, by batches whose centers move by a decaying mean.

    Args:
        rows: (N, F).
        weights: (N,) importance of each row, > 0.
        count: Number of centers, at most N.
        rounds: Number of batches.
        seed: Seed of the batches and the first centers.

    Returns:
        (count, F) centers.
    """
    count = min(count, len(rows))
    generator = torch.Generator().manual_seed(seed)
    centers = rows[torch.randperm(len(rows), generator=generator)[:count]].clone()
    held = torch.ones(count)
    for _ in range(rounds):
        batch = torch.randint(len(rows), (min(_BATCH, len(rows)),), generator=generator)
        some, weight = rows[batch], weights[batch]
        at = nearest(some, centers)
        sums = torch.zeros_like(centers).index_add_(0, at, some * weight[:, None])
        total = torch.zeros(count).index_add_(0, at, weight)
        hit = total > 0
        held[hit] = 0.8 * held[hit] + total[hit]
        share = (total[hit] / held[hit])[:, None]
        centers[hit] += share * (sums[hit] / total[hit][:, None] - centers[hit])
    return centers


def nearest(rows: Tensor, centers: Tensor) -> Tensor:
    """Return (N,) the index of the nearest center of each row."""
    found = []
    half = 0.5 * centers.square().sum(dim=1)
    for start in range(0, len(rows), _BATCH // 4):
        part = rows[start : start + _BATCH // 4]
        found.append((half - part @ centers.T).argmin(dim=1))
    return torch.cat(found)


def quantize_ends(values: Tensor) -> tuple[Tensor, Tensor]:
    """Return the least and the largest value of each column, (1, F) each."""
    return values.detach().amin(dim=0, keepdim=True), values.detach().amax(dim=0, keepdim=True)


def fake_quantize(values: Tensor, bits: int = 8) -> Tensor:
    """Return values (N, F) rounded to steps between the ends of each column; gradients pass as if they were not."""
    low, high = quantize_ends(values)
    step = (high - low).clamp(min=1e-12) / (2**bits - 1)
    rounded: Tensor = low + torch.round((values.detach() - low) / step) * step
    return values - values.detach() + rounded
