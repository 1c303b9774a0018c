"""Build a hierarchical z-buffer for Gaussians: how far an eye sees in every direction, and which Gaussians it sees.

Gaussians are splatted front to back onto a cube around the eye (EWA, as in the rasterizer, but ordered by distance, so
that no direction is special). Blur does not add to the light that a Gaussian takes (Yu et al. 2024, "Mip-Splatting"),
so light passes between Gaussians smaller than a pixel. Gaussians behind spent light are skipped a cluster at a time.
The depth is recorded where light is spent. Pyramids of least and largest depths test anything else. World frame, scene
units.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis import _check
from gsvis._sorting import stable_order
from gsvis.hpr._kernels import clusters
from gsvis.hpr._kernels import splat as kernels
from gsvis.hpr._kernels.reach import CLUSTER
from gsvis.hpr._kernels.sphere import hidden_behind
from gsvis.raycast.proxies import MIN_ALPHA
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.lengths import length_factor

__all__ = ["FOLDS", "Search", "Seen", "Splats", "ZBuffer", "look_around", "squares_around"]

F32 = NDArray[np.float32]
I64 = NDArray[np.int64]
Mask = NDArray[np.bool_]

_MAX_SIZE = 4096
FOLDS = (1, 2, 4, 8, 16, 32, 64)
"""Pixels along a side of the blocks of which a z-buffer can keep the largest depth."""


@dataclass(frozen=True, eq=False)
class Splats:
    """The M Gaussians of a scene that can be visible, laid out for splatting; made once and used from every eye.

    Attributes:
        ids: (M,) int64, the Gaussian of each row.
        near: (M, 8) float32: mean, largest scale, reach in standard deviations, opacity, its log2, one unused.
        covars: (M, 6) float32, upper triangle of the covariance.
        bounds: (B, 8) float32: of each cluster of 64 neighboring rows, least and largest mean, largest product of scale
            and reach, largest reach.
        columns: (B, 5, 64) float32: of the rows of each cluster, x, y and z of the mean, scale times reach, reach.
        total: N, all Gaussians of the scene.
        factor: Units of the rows per scene unit, a power of two; see `length_factor`.
    """

    ids: I64
    near: F32
    covars: F32
    bounds: F32
    columns: F32
    total: int
    factor: float = 1.0

    @classmethod
    def from_gaussians(cls, g: Gaussians) -> Splats:
        """Lay out a scene. Rows are ordered by content, so that no result depends on the order of the scene."""
        ids = _in_order(g, np.flatnonzero(g.opacities >= MIN_ALPHA))
        near = np.zeros((len(ids), 8), np.float32)
        near[:, :3], near[:, 3], near[:, 5] = g.means[ids], g.scales[ids].max(axis=1, initial=0.0), g.opacities[ids]
        factor = length_factor(g.means)
        near[:, :4] *= np.float32(factor)
        near[:, 4] = np.sqrt(2.0 * np.log(np.maximum(near[:, 5].astype(np.float64) / MIN_ALPHA, 1.0)))
        near[:, 6] = np.log2(near[:, 5])
        covars = np.empty((len(ids), 6), np.float32)
        step = 1 << 16
        for start in range(0, len(ids), step):
            full = g[ids[start : start + step]].covars()
            covars[start : start + step] = full[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]] * np.float32(factor**2)
        count = -(-len(ids) // CLUSTER)
        bounds = np.empty((count, 8), np.float32)
        columns = np.empty((count, 5, CLUSTER), np.float32)
        clusters.bound_clusters(near, bounds, columns)
        return cls(ids, near, covars, bounds, columns, len(g), factor)

    @cached_property
    def rows(self) -> NDArray[np.int32]:
        """(N,) row of each Gaussian; -1 for those that cannot be visible."""
        rows = np.full(self.total, -1, np.int32)
        rows[self.ids] = np.arange(len(self.ids), dtype=np.int32)
        return rows

    @property
    def nbytes(self) -> int:
        """Bytes held."""
        return sum(a.nbytes for a in (self.ids, self.near, self.covars, self.bounds, self.columns))


@dataclass(frozen=True, eq=False)
class ZBuffer:
    """Depths around an eye at which its light is spent.

    Attributes:
        viewpoint: (3,) float64, world frame.
        spent: Transmittance below which light counts as spent.
        depths: (6, S, S) float32, distance from the eye; inf if light is left. Faces look along +x, -x, +y, -y, +z,
            -z; on each, columns run along the first and rows along the second of the other two axes.
        light: (6, S, S) float32, transmittance behind everything splatted; where light is spent, the first value below
            `spent`. (6, 0, 0) where only the largest depths of blocks of pixels were kept.
    """

    viewpoint: NDArray[np.float64]
    spent: float
    depths: F32
    light: F32

    @property
    def size(self) -> int:
        """Pixels along a side of a face."""
        return int(self.depths.shape[1])

    def pyramid(self, *, largest: bool = True) -> list[F32]:
        """Return levels (6, S_k, S_k) of the largest or least depths over 2^k x 2^k pixels, finest first."""
        fold = np.maximum if largest else np.minimum
        levels = [self.depths]
        while levels[-1].shape[1] > 1:
            finer = levels[-1]
            if finer.shape[1] % 2:
                finer = np.pad(finer, ((0, 0), (0, 1), (0, 1)), mode="edge")
            rows = fold(finer[:, ::2], finer[:, 1::2])
            levels.append(fold(rows[:, :, ::2], rows[:, :, 1::2]))
        return levels

    def hides(self, splats: Splats) -> Mask:
        """Find the Gaussians that lie fully behind the depths, by a conservative test.

        The ball around each Gaussian is hidden if its nearest distance lies behind the largest depth under its
        footprint, widened by a pixel. A hidden Gaussian has no pixel with `spent` of the light in front; the converse
        does not hold.

        Args:
            splats: Any scene, M rows.

        Returns:
            (M,) mask over the rows of `splats`.

        References:
            Greene, Kass and Miller 1993, "Hierarchical Z-buffer visibility".
        """
        levels = self.pyramid()
        first = np.concatenate([[0], np.cumsum([level.shape[1] for level in levels])]).astype(np.int64)
        stacked = np.full((6, int(first[-1]), self.size), np.inf, np.float32)
        for start, level in zip(first, levels, strict=False):
            stacked[:, start : start + level.shape[1], : level.shape[2]] = level
        hidden = np.zeros(len(splats.near), bool)
        eye = self.viewpoint * splats.factor
        depths = stacked * np.float32(splats.factor)
        hidden_behind(splats.near, eye, depths, first[:-1], self.size, hidden)
        return hidden


@dataclass(frozen=True, eq=False)
class Seen:
    """What an eye sees around it.

    Attributes:
        ids: (K,) int64, ascending: the Gaussians that some light reaches.
        weights: (K,) float32, largest share of a pixel's light that each takes, over the pixels where light is not
            spent in front. A Gaussian much larger than a pixel takes its weight at the center; one smaller than a
            pixel takes less: by the root of the share of its blurred splat that it covers, halfway (as a ratio)
            between what a ray finds and what an image shows.
        light: (K,) float32, largest transmittance in front of each, over the pixels it reaches; opacity times this
            is the weight of its peak there.
        zbuffer: Where the light ends.
    """

    ids: I64
    weights: F32
    light: F32
    zbuffer: ZBuffer


@dataclass(frozen=True, eq=False, kw_only=True)
class Search:
    """What a look is for, so that it may be faster: where, and which of N Gaussians.

    Attributes:
        squares: (6, T, T) squares of pixels to look at, from `squares_around` of the same size; None looks at all.
        known: (N,) mask of Gaussians whose weights do not matter; None for none. With `least` above 0 they are not
            among what is seen.
        least: Weight below which no other Gaussian matters either. Specks that do not matter are thinned: one of up to
            16 neighbors, each much smaller than a pixel, takes the light of all. 0 thins nothing.
    """

    squares: Mask | None = None
    known: Mask | None = None
    least: float = 0.0

    def squares_of(self, size: int) -> Mask:
        """Return the mask of squares of faces of `size` pixels.

        Raises:
            ValueError: If the squares belong to another size.
        """
        side = -(-size // kernels.SQUARE)
        if self.squares is None:
            return np.ones((6, side, side), bool)
        if self.squares.shape != (6, side, side):
            raise ValueError(
                f"squares: expected shape {(6, side, side)} for faces of {size} pixels, got {self.squares.shape}"
            )
        return self.squares

    def known_rows(self, splats: Splats) -> NDArray[np.uint64]:
        """Return for each cluster of rows a word (B,) with bit k set if its row k is known.

        Raises:
            ValueError: If the mask belongs to another scene.
        """
        words = np.zeros(len(splats.bounds), np.uint64)
        if self.known is not None:
            if self.known.shape != (splats.total,):
                raise ValueError(f"known: expected shape ({splats.total},), got {self.known.shape}")
            kernels.pack_known(self.known, splats.ids, words)
        return words


def look_around(
    splats: Splats,
    viewpoint: ArrayLike,
    *,
    size: int = 256,
    spent: float = MIN_ALPHA,
    buffer: bool = True,
    fold: int = 1,
    search: Search | None = None,
) -> Seen:
    """Splat a scene around an eye, front to back, and keep the Gaussians that light reaches.

    Args:
        splats: The scene.
        viewpoint: (3,) world frame.
        size: Pixels along a side of the six faces, 4 to 4096.
        spent: Transmittance in (0, 1) below which light counts as spent; Gaussians without a brighter pixel in
            front are dropped. To find all weights of tau, it must be at most tau.
        buffer: False keeps no depths: the z-buffer has faces of 0 x 0 pixels, and pixels that no Gaussian reaches cost
            nothing.
        fold: Pixels along a side of the blocks of which the z-buffer keeps the largest depth, 1 to 64, a power of two.
            Above 1 it keeps no light, and is that level of its `pyramid`.
        search: What is looked for, and where; None finds everything everywhere. Squares need `buffer` to be False.

    Raises:
        ValueError: If an argument is out of range.
    """
    eye = _check.floats("viewpoint", viewpoint, (3,), np.float64)
    if not 4 <= _check.positive_int("size", size) <= _MAX_SIZE:
        raise ValueError(f"size: expected 4 to {_MAX_SIZE} pixels, got {size}")
    if not 0.0 < spent < 1.0:
        raise ValueError(f"spent: expected a transmittance in (0, 1), got {spent!r}")
    if fold not in FOLDS:
        raise ValueError(f"fold: expected a power of two from 1 to {FOLDS[-1]}, got {fold!r}")
    search = search or Search()
    squares = search.squares_of(size)
    if buffer and not squares.all():
        raise ValueError("buffer: expected False with squares, as the z-buffer has no depths elsewhere; got True")
    words = search.known_rows(splats)
    at = (eye * splats.factor).astype(np.float32)
    nearest = np.empty(len(splats.bounds), np.float32)
    rectangles = np.empty((6, len(splats.bounds), 4), np.int16)
    clusters.place_clusters(splats.bounds, at, size, nearest, rectangles)
    lists = np.empty((6, len(nearest)), np.int64)
    counts = np.empty(6, np.int64)
    listed = np.empty_like(rectangles)
    clusters.list_clusters(stable_order(nearest), rectangles, lists, listed, counts)
    side = -(-size // fold) if buffer else 0
    light = np.empty((6, side, side) if fold == 1 else (6, 0, 0), np.float32)
    depths = np.full((6, side, side), np.inf, np.float32)
    best = np.zeros(2 * splats.total, np.float32)
    kernels.splat_squares(
        (splats.near, splats.covars, splats.columns, splats.ids),
        (words, np.float32(search.least)),
        at,
        size,
        np.float32(spent),
        nearest,
        listed,
        lists,
        counts,
        squares,
        best,
        fold,
        light,
        depths,
    )
    ids, (weights, clear) = kernels.take_found(best)
    if splats.factor != 1.0:
        depths /= np.float32(splats.factor)
    return Seen(ids, weights, clear, ZBuffer(eye, spent, depths, light))


def squares_around(splats: Splats, viewpoint: ArrayLike, ids: ArrayLike, size: int) -> Mask:
    """Find the squares of pixels around an eye that some Gaussians may reach.

    Args:
        splats: The scene.
        viewpoint: (3,) world frame.
        ids: (K,) Gaussians of the scene; those that cannot be visible are left out.
        size: S, pixels along a side of the six faces.

    Returns:
        (6, T, T) mask of the T = ceil(S / 64) squares along a side, by face, row and column. Conservative: the ball
        around each Gaussian is taken.
    """
    eye = _check.floats("viewpoint", viewpoint, (3,), np.float64)
    rows = splats.rows[_check.integers("ids", ids, ("K",))]
    near = splats.near[rows[rows >= 0]]
    reach = near[:, 3] * near[:, 4]
    bounds = np.concatenate([near[:, :3], near[:, :3], reach[:, None], near[:, 4:5]], axis=1)
    rectangles = np.empty((6, len(near), 4), np.int16)
    at = (eye * splats.factor).astype(np.float32)
    clusters.place_clusters(bounds, at, size, np.empty(len(near), np.float32), rectangles)
    count = -(-size // kernels.SQUARE)
    squares = np.zeros((6, count, count), bool)
    clusters.mark_squares(rectangles, kernels.SQUARE, squares)
    return squares


def _in_order(g: Gaussians, ids: I64) -> I64:
    """Return the ids along a Morton curve through the means; ties are ordered by content."""
    if len(ids) == 0:
        return ids
    means = g.means[ids].astype(np.float64)
    low = means.min(axis=0)
    high = means.max(axis=0)
    steps = ((means - low) / np.maximum(high - low, 1e-300) * ((1 << 21) - 1)).astype(np.uint64)
    code = np.zeros(len(ids), np.uint64)
    for axis in range(3):
        code |= _spread(steps[:, axis]) << np.uint64(axis)
    order = stable_order(code)
    same = np.flatnonzero(np.diff(code[order]) == 0)
    if len(same):
        alike = np.unique(np.concatenate([same, same + 1]))
        some = ids[order[alike]]
        content = np.concatenate(
            [g.means[some], g.scales[some], g.quats[some], g.opacities[some, None], g.sh0[some, 0]], axis=1
        )
        order[alike] = order[alike][np.lexsort((*content.T[::-1], code[order[alike]]))]
    return np.asarray(ids[order])


def _spread(values: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Return the 21 bits of each value, with two zeros between neighbors."""
    for shift, mask in (
        (32, 0x1F00000000FFFF),
        (16, 0x1F0000FF0000FF),
        (8, 0x100F00F00F00F00F),
        (4, 0x10C30C30C30C30C3),
        (2, 0x1249249249249249),
    ):
        values = (values | (values << np.uint64(shift))) & np.uint64(mask)
    return values
