"""Cut levels into segments in space, and make pieces of them: files of a level of detail, or layers that add up.

Levels run from low to high. A file of a level of detail holds all of its Gaussians, also those that the level below has
already brought, as streamed SOG does. A layer holds only what it adds. Scene frame and units.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis import _check
from gsvis.package.contents import Contents
from gsvis.scene.morton import morton_order
from paper.rivals.pieces import Pieces, boxes_of

__all__ = ["Segments", "added_at_level", "layers_by_importance", "level_files", "level_layers"]

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
I64 = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Segments:
    """N Gaussians of a package in B segments.

    Attributes:
        of: (N,) segment of each Gaussian; -1 for those that belong to none, such as flyaways.
        means: (N, 3) centers.
        scales: (N, 3) standard deviations.
        opacities: (N,) opacities.
        boxes: (B, 2, 3) boxes around the segments.
    """

    of: I64
    means: F32
    scales: F32
    opacities: F32
    boxes: F64

    @classmethod
    def of_contents(cls, contents: Contents, of: ArrayLike | None = None, most: int = 8192) -> Segments:
        """Return segments of a package.

        Args:
            contents: The package.
            of: (N,) segment of each Gaussian; None cuts the chunks of the highest level, which lie along a Morton
                curve, into runs of about `most` Gaussians. Gaussians of lower levels join the segment nearest to them.
            most: Gaussians of a segment.
        """
        g = contents.gaussians()
        found = _runs(contents, g.means, most) if of is None else np.asarray(of, np.int64)
        _check.same_length(of=found, means=g.means)
        groups = [np.flatnonzero(found == b) for b in range(int(found.max(initial=-1)) + 1)]
        return cls(found, g.means, g.scales, g.opacities, boxes_of(g.means, g.scales, groups))

    def __len__(self) -> int:
        """Return B."""
        return len(self.boxes)

    def ids(self, chosen: NDArray[np.bool_]) -> list[I64]:
        """Return the ids of each segment among those chosen (N,)."""
        ids = np.flatnonzero(chosen & (self.of >= 0))
        ids = ids[np.argsort(self.of[ids], kind="stable")]
        return np.split(ids, np.searchsorted(self.of[ids], np.arange(1, len(self))))

    @property
    def areas(self) -> F64:
        """(N,) product of the two largest standard deviations: the size of an ellipsoid as it is mostly seen."""
        ordered = np.sort(self.scales.astype(np.float64), axis=1)
        return np.asarray(ordered[:, 1] * ordered[:, 2])


def added_at_level(contents: Contents, level: int) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return (N,) which Gaussians a level has and the one below has not, and (N,) which are the other way round."""
    first = contents.first
    last = contents.last
    return np.asarray(first == level), np.asarray(last == level - 1)


def level_files(contents: Contents, segments: Segments, sizes: ArrayLike) -> Pieces:
    """Return one piece for each level and segment, lowest level first, with the sizes of whole files.

    Args:
        contents: The package.
        segments: B segments.
        sizes: (L, B) bytes of the file of each level and segment, lowest level first; 0 where there is none.
    """
    levels = len(contents.names)
    count = len(segments)
    nbytes = _check.integers("sizes", sizes, (levels, count))
    return _pieces(contents, segments, nbytes.reshape(-1))


def level_layers(contents: Contents, segments: Segments, gaussian_bytes: float) -> Pieces:
    """Return one piece for each level and segment, lowest first, with the bytes of what it adds.

    Args:
        contents: The package.
        segments: B segments.
        gaussian_bytes: Measured bytes of a Gaussian with its view-dependent color.
    """
    counts = []
    for level in range(len(contents.names)):
        counts.append([len(ids) for ids in segments.ids(added_at_level(contents, level)[0])])
    return _pieces(contents, segments, np.ceil(np.array(counts) * gaussian_bytes).astype(np.int64).reshape(-1))


def layers_by_importance(contents: Contents, segments: Segments, gaussian_bytes: float, count: int = 3) -> Pieces:
    """Return `count` pieces for each segment: the highest level in equal parts, the most important first.

    The importance of a Gaussian is its opacity times its area.

    Args:
        contents: The package.
        segments: B segments.
        gaussian_bytes: Measured bytes of a Gaussian with its view-dependent color.
        count: Number of layers.
    """
    highest = contents.last == len(contents.names) - 1
    worth = segments.opacities * segments.areas
    layers: list[list[I64]] = [[] for _ in range(_check.positive_int("count", count))]
    for ids in segments.ids(np.asarray(highest)):
        ordered = ids[np.argsort(-worth[ids], kind="stable")]
        for layer, some in zip(layers, np.array_split(ordered, count), strict=True):
            layer.append(np.sort(some))
    gaussians = [ids for layer in layers for ids in layer]
    none = [np.zeros(0, np.int64)] * len(gaussians)
    nbytes = np.array([int(np.ceil(len(ids) * gaussian_bytes)) for ids in gaussians], np.int64)
    boxes = np.tile(segments.boxes, (count, 1, 1))
    return Pieces(gaussians, none, nbytes, boxes, _below(count, len(segments)))


def _pieces(contents: Contents, segments: Segments, nbytes: I64) -> Pieces:
    levels = len(contents.names)
    count = len(segments)
    gaussians: list[I64] = []
    dropped: list[I64] = []
    for level in range(levels):
        new, old = added_at_level(contents, level)
        gaussians += segments.ids(new)
        dropped += segments.ids(old)
    kept = [
        int(size) if size > 0 else (1 if len(a) + len(b) else 0)
        for size, a, b in zip(nbytes.tolist(), gaussians, dropped, strict=True)
    ]
    boxes = np.tile(segments.boxes, (levels, 1, 1))
    return Pieces(gaussians, dropped, np.array(kept, np.int64), boxes, _below(levels, count))


def _below(levels: int, count: int) -> I64:
    """Return (levels * count,) the piece one level below in the same segment, -1 in the lowest."""
    return np.maximum(np.arange(levels * count, dtype=np.int64) - count, -1)


def _runs(contents: Contents, means: F32, most: int) -> I64:
    """Return (N,) segments: runs of the highest level in the order of the package; others by the nearest chunk."""
    from scipy.spatial import cKDTree  # slow to import

    highest = np.flatnonzero(contents.last == len(contents.names) - 1)
    out = np.empty(len(contents), np.int64)
    points = means[highest].astype(np.float64)
    order = morton_order(points)
    parts = max(1, -(-len(order) // _check.positive_int("most", most)))
    own = np.empty(len(order), np.int64)
    own[order] = np.arange(len(order)) * parts // max(len(order), 1)
    out[highest] = own
    others = np.flatnonzero(contents.last != len(contents.names) - 1)
    if len(others):
        out[others] = own[cKDTree(points).query(means[others].astype(np.float64))[1]]
    return out
