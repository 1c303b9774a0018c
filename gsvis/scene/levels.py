"""Define quality levels that share Gaussians: one union, and the first and last level of each of its Gaussians.

Levels run from low to high. A Gaussian in two neighboring levels is identical in both, so an upgrade sends only the
others. This module knows no file, no camera and no training.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis import _check
from gsvis.scene.gaussians import Gaussians

__all__ = ["PREVIEW", "Levels", "as_levels", "level_scenes", "levels_record", "union_of"]

I64 = NDArray[np.int64]

PREVIEW = 0.1
"""Largest share of the Gaussians of the highest level in a first picture; the default of `AbrConfig.picture`."""


@dataclass(frozen=True, init=False, eq=False, repr=False)
class Levels:
    """N Gaussians of all levels together; each belongs to the levels `first` to `last`.

    Args:
        union: N Gaussians, each once.
        first: (N,) lowest level with this Gaussian; 0 is the lowest of all.
        last: (N,) highest level with this Gaussian, >= first.
        names: L names, lowest first.

    Raises:
        ValueError: If lengths differ, a level is out of range, or a level is empty.

    Examples:
        >>> balls = Gaussians(np.zeros((3, 3)), [[1, 0, 0, 0]] * 3, np.ones((3, 3)), [1] * 3, np.zeros((3, 1, 3)))
        >>> Levels(balls, first=[0, 0, 1], last=[1, 0, 1], names=("low", "high"))
        Levels(low 2, high 2 of 3; reuse 50.0%)
    """

    union: Gaussians
    first: NDArray[np.uint8]
    last: NDArray[np.uint8]
    names: tuple[str, ...]

    def __init__(self, union: Gaussians, first: ArrayLike, last: ArrayLike, names: tuple[str, ...] | list[str]) -> None:
        names = tuple(names)
        if not 1 <= len(names) <= 16 or len(set(names)) != len(names):
            raise ValueError(f"names: expected 1 to 16 different names, got {names!r}")
        low, high = (
            _check.integers(name, value, ("N",), np.uint8) for name, value in (("first", first), ("last", last))
        )
        _check.same_length(union=union.means, first=low, last=high)
        for name, value in (("first", low), ("last", high)):
            _check.in_range(name, value, 0, len(names) - 1)
        if (low > high).any():
            raise ValueError(f"last: expected at least first, got less at index {int(np.argmax(low > high))}")
        for array in (low := low.view(), high := high.view()):
            array.flags.writeable = False
        object.__setattr__(self, "union", union)
        object.__setattr__(self, "first", low)
        object.__setattr__(self, "last", high)
        object.__setattr__(self, "names", names)
        empty = [name for k, name in enumerate(names) if not self.member(k).any()]
        if empty:
            raise ValueError(f"first: expected a Gaussian in every level, got none in {empty[0]!r}")

    @classmethod
    def single(cls, gaussians: Gaussians, name: str = "high") -> Levels:
        """Return a scene without levels as one level."""
        none = np.zeros(len(gaussians), np.uint8)
        return cls(gaussians, none, none, (name,))

    def __len__(self) -> int:
        """Number of levels."""
        return len(self.names)

    def __repr__(self) -> str:
        sizes = ", ".join(f"{name} {count:,}" for name, count in zip(self.names, self.counts, strict=True))
        reuse = ", ".join(f"{100 * share:.1f}%" for share in self.reuse)
        return f"Levels({sizes} of {len(self.union):,}" + (f"; reuse {reuse})" if reuse else ")")

    def member(self, level: int) -> NDArray[np.bool_]:
        """Return a mask (N,): whether each Gaussian of the union belongs to a level."""
        if not 0 <= level < len(self.names):
            raise ValueError(f"level: expected 0 to {len(self.names) - 1}, got {level!r}")
        return np.asarray((self.first <= level) & (level <= self.last))

    def level(self, level: int) -> Gaussians:
        """Return the Gaussians of a level, in the order of the union."""
        return self.union[self.member(level)]

    def bare_level(self, level: int) -> Gaussians:
        """Return the Gaussians of a level without SH above degree 0, for work that needs no colors."""
        return self.union.without_harmonics()[self.member(level)]

    def drawn_level(self, level: int) -> Gaussians:
        """Return the union, not copied, of which only a level is visible: for images of the level."""
        return self.union.showing(self.member(level))

    @property
    def counts(self) -> tuple[int, ...]:
        """Number of Gaussians of each level."""
        return tuple(int(self.member(k).sum()) for k in range(len(self)))

    @property
    def reuse(self) -> tuple[float, ...]:
        """Share of each level that belongs to the next level too: L - 1 values in [0, 1]."""
        return tuple(float((self.member(k) & self.member(k + 1)).sum() / self.counts[k]) for k in range(len(self) - 1))

    @property
    def previews(self) -> int:
        """Number of first pictures: lowest levels of at most `PREVIEW` that share nothing with the next level."""
        counts = self.counts
        return next((k for k, r in enumerate(self.reuse) if r > 0.0 or counts[k] > PREVIEW * counts[-1]), len(self) - 1)

    @property
    def overhead(self) -> float:
        """Gaussians that an upgrade through all levels sends in addition to the highest level, as a share of it."""
        return len(self.union) / self.counts[-1] - 1.0


def union_of(scene: Gaussians | Levels) -> Gaussians:
    """Return the Gaussians that ids refer to: the union of levels, or the scene itself."""
    return scene.union if isinstance(scene, Levels) else scene


def as_levels(scene: Gaussians | Levels) -> Levels:
    """Return levels; a scene without levels becomes one level.

    Raises:
        ValueError: If the scene is empty.
    """
    return scene if isinstance(scene, Levels) else Levels.single(scene)


def level_scenes(levels: Levels) -> Iterator[tuple[Gaussians, I64]]:
    """Yield each level as a scene, lowest first, with the (n,) ascending ids of its Gaussians in the union."""
    for k in range(len(levels)):
        ids = np.flatnonzero(levels.member(k))
        yield (levels.union if len(ids) == len(levels.union) else levels.union[ids]), ids


def levels_record(scene: Gaussians | Levels) -> dict[str, Any] | None:
    """Return names, counts and a hash of the memberships for JSON; None for a scene or a single level."""
    if not isinstance(scene, Levels) or len(scene) == 1:
        return None
    membership = hashlib.sha256(b"gsvis levels 1\n" + scene.first.tobytes() + scene.last.tobytes()).hexdigest()
    return {"names": list(scene.names), "counts": list(scene.counts), "membership": membership}
