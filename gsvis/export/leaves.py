"""Cut levels of a scene into leaves: boxes of a binary tree with similar numbers of Gaussians, in Morton order.

A node is cut at the median across its longest side while the largest level has too many Gaussians in it, so all leaves
have a similar size. Gaussians far outside of a scene, such as flyaways, would make the box of a leaf huge; they become
the environment, which viewers always draw. Scene frame and units.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from gsvis import _check
from gsvis.errors import SceneError
from gsvis.io.streamed_sog_writer import LeafScene, Tree
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.levels import Levels
from gsvis.scene.morton import morton_codes

__all__ = ["LEAF", "Leaves", "cut_leaves"]

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

LEAF = 8192
"""Default of the largest number of Gaussians of a leaf at one level."""
_FAR = 3.0  # half sides of the box with 98% of the centers, beyond which the environment begins
_MOST_FAR = 0.01  # largest share of Gaussians in the environment; if more are far, they stay in leaves
_ROWS = 1 << 16


@dataclass(frozen=True, eq=False)
class Leaves:
    """The leaves of levels.

    Attributes:
        levels: The levels. Level of detail 0 is the highest of them.
        tree: Leaves 0 to B - 1 from left to right.
        of_ids: (N,) int32 leaf of each Gaussian of the union; -1 for none.
        environment: (E,) ascending ids of the Gaussians of the highest level that lie far outside.
        lowest: The lowest level that has a level of detail.
    """

    levels: Levels
    tree: Tree
    of_ids: NDArray[np.int32]
    environment: I64
    lowest: int = 0

    def __len__(self) -> int:
        """Return the number of leaves."""
        return int(self.of_ids.max()) + 1

    @cached_property
    def order(self) -> I64:
        """(M,) ids of all Gaussians in leaves: leaf by leaf, along a Morton curve in each leaf."""
        ids = np.flatnonzero(self.of_ids >= 0)
        means = self.levels.union.means[ids]
        low = means.min(axis=0).astype(np.float64)
        high = means.max(axis=0).astype(np.float64)
        codes = morton_codes(means, (low + high) / 2.0, max(float((high - low).max()) / 2.0, 1e-30))
        return np.asarray(ids[np.lexsort((ids, codes, self.of_ids[ids]))], np.int64)

    @cached_property
    def starts(self) -> I64:
        """(B + 1,) place in `order` at which each leaf begins, then M."""
        return np.concatenate([[0], np.cumsum(np.bincount(self.of_ids[self.order], minlength=len(self)))])

    @cached_property
    def counts(self) -> I64:
        """(L, B) Gaussians of each leaf at each level of detail, finest first."""
        members = [self.levels.member(k)[self.order] for k in self._levels]
        owners = self.of_ids[self.order]
        return np.array([np.bincount(owners[member], minlength=len(self)) for member in members], np.int64)

    @cached_property
    def finest(self) -> NDArray[np.bool_]:
        """(N,) whether each Gaussian belongs to the finest level that its leaf has."""
        level = len(self.levels) - 1 - np.argmax(self.counts > 0, axis=0)
        own = level[np.maximum(self.of_ids, 0)]
        return np.asarray((self.of_ids >= 0) & (self.levels.first <= own) & (own <= self.levels.last))

    @property
    def _levels(self) -> range:
        """Numbers of the levels, highest first."""
        return range(len(self.levels) - 1, self.lowest - 1, -1)

    def ids(self, lod: int, leaf: int) -> I64:
        """Return the ids of a leaf at a level of detail, in the order of the file."""
        ids = self.order[self.starts[leaf] : self.starts[leaf + 1]]
        level = len(self.levels) - 1 - lod
        return np.asarray(ids[(self.levels.first[ids] <= level) & (level <= self.levels.last[ids])], np.int64)

    @cached_property
    def bounds(self) -> F64:
        """(B, 2, 3) boxes of the leaves that hold one standard deviation of each Gaussian."""
        return self.boxes(1.0)

    def boxes(self, deviations: float) -> F64:
        """Return (B, 2, 3) boxes of the leaves that hold a number of standard deviations of each Gaussian."""
        reach = deviations * _reach(self.levels.union)[self.order]
        means = self.levels.union.means[self.order].astype(np.float64)
        low = np.minimum.reduceat(means - reach, self.starts[:-1], axis=0)
        high = np.maximum.reduceat(means + reach, self.starts[:-1], axis=0)
        return np.stack([low, high], axis=1)

    def environment_box(self, deviations: float) -> F64:
        """Return the (2, 3) box of the environment, see `boxes`; there must be an environment."""
        far = self.levels.union[self.environment]
        reach = deviations * _reach(far)
        means = far.means.astype(np.float64)
        return np.stack([(means - reach).min(axis=0), (means + reach).max(axis=0)])

    def as_scene(self) -> LeafScene:
        """Return the leaves as input of the writer of streamed SOG."""
        union = self.levels.union
        far = union[self.environment] if len(self.environment) else None
        return LeafScene(self.tree, self.bounds, self.counts, lambda lod, leaf: union[self.ids(lod, leaf)], far)


def cut_leaves(levels: Levels, *, most: int = LEAF, kept: NDArray[np.bool_] | None = None, lowest: int = 0) -> Leaves:
    """Return the leaves of levels.

    Args:
        levels: The levels.
        most: Largest number of Gaussians of a leaf at one level, at least 1.
        kept: (N,) mask of Gaussians of the union to keep; None keeps all.
        lowest: The lowest level to keep.

    Raises:
        SceneError: If none is kept.
        ValueError: If `most` is not at least 1.
    """
    _check.positive_int("most", most)
    union = levels.union
    some = (levels.last >= lowest) & (True if kept is None else np.asarray(kept, np.bool_))
    if not some.any():
        raise SceneError("leaves: no Gaussian is left; nothing to write")
    far = some & _are_far(union)
    near = some & ~far
    if far.sum() > _MOST_FAR * some.sum() or not near.any():
        far = np.zeros_like(some)
        near = some
    of_ids = np.full(len(union), -1, np.int32)
    counter = [0]
    members = [levels.member(k) for k in range(lowest, len(levels))]

    def cut(ids: I64) -> Tree:
        """Return the tree of some Gaussians, cut recursively."""
        if max(int(member[ids].sum()) for member in members) > most:
            means = union.means[ids]
            axis = int(np.ptp(means, axis=0).argmax())
            order = np.argsort(means[:, axis], kind="stable")
            half = len(ids) // 2
            return cut(ids[np.sort(order[:half])]), cut(ids[np.sort(order[half:])])
        of_ids[ids] = counter[0]
        counter[0] += 1
        return counter[0] - 1

    tree = cut(np.flatnonzero(near))
    environment = np.flatnonzero(far & members[-1])
    return Leaves(levels, tree, of_ids, environment.astype(np.int64), lowest)


def _are_far(g: Gaussians) -> NDArray[np.bool_]:
    """Return a mask (N,): whether each Gaussian lies far outside of the box that holds 98% of the centers."""
    low, high = g.bounds(0.98)
    half = np.maximum((high - low) / 2.0, 1e-3 * float((high - low).max()) + 1e-30)
    return np.asarray((np.abs(g.means - (low + high) / 2.0) > _FAR * half).any(axis=1))


def _reach(g: Gaussians) -> F64:
    """Return (N, 3) half sides of the boxes around one standard deviation of each Gaussian."""
    out = np.empty((len(g), 3))
    for start in range(0, len(g), _ROWS):
        some = g[start : start + _ROWS]
        out[start : start + _ROWS] = np.einsum("nij,nj->ni", np.abs(some.rotations()), some.scales.astype(np.float64))
    return out
