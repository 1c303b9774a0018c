"""Random SRBF colors of every variant, for tests of what uses them."""

from __future__ import annotations

import numpy as np

from gsvis.color.srbf import SrbfColors
from gsvis.color.variants import variant


def random_colors(rng: np.random.Generator, count: int, name: str = "rgb", most_terms: int = 5) -> SrbfColors:
    """Colors of `count` Gaussians with 0 to `most_terms` terms each; bases within the gamut of their space."""
    kind = variant(name)
    counts = rng.integers(0, most_terms + 1, count)
    total = int(counts.sum())
    return SrbfColors(
        name,
        rng.uniform(0.1, 0.9, (count, 3)).astype(np.float32),
        np.ones(count, np.float32) if kind.space == "rgb" else rng.uniform(0.5, 2.0, count).astype(np.float32),
        np.concatenate([np.zeros(1, np.int64), np.cumsum(counts)]),
        rng.integers(0, len(kind.functions), total).astype(np.uint8),
        np.stack([rng.uniform(0, np.pi, total), rng.uniform(-np.pi, np.pi, total)], axis=1).astype(np.float32),
        np.exp(rng.uniform(np.log(0.2), np.log(30.0), total)).astype(np.float32),
        rng.normal(scale=0.2, size=(total, kind.intensities)).astype(np.float32),
    )
