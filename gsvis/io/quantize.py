"""Vector quantization for files: codebooks of numbers and palettes of vectors.

Deterministic: the same values give the same entries. This module knows no Gaussians.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

__all__ = ["codebook_of", "distinct_rows", "nearest_entry", "palette_of"]

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
Number = TypeVar("Number", bound=np.number[Any])
_ENTRIES = 256
_ROUNDS = 8
_SAMPLE = 1 << 16
_BLOCK = 1 << 23  # entries of a distance matrix in memory


def codebook_of(values: F32) -> F32:
    """Return (256,) ascending numbers that represent all values with a small mean squared error.

    Args:
        values: Any shape, at least one value.

    Returns:
        The distinct values themselves, the last repeated, if there are at most 256.

    References:
        Lloyd, "Least squares quantization in PCM", 1982; start by Panter and Dite, density to the power 1/3.
    """
    distinct = np.unique(values)
    if len(distinct) <= _ENTRIES:
        return np.pad(distinct, (0, _ENTRIES - len(distinct)), mode="edge").astype(np.float32)
    ordered = np.sort(values, axis=None).astype(np.float64)
    counts, edges = np.histogram(ordered, bins=4096)
    density = np.cbrt(counts)
    share = np.cumsum(0.75 * density / density.sum() + 0.25 / len(counts))  # an even quarter keeps outliers close
    entries = np.interp((np.arange(_ENTRIES) + 0.5) / _ENTRIES, share, edges[1:])
    sums = np.concatenate([[0.0], np.cumsum(ordered)])
    for _ in range(_ROUNDS):
        cuts = np.searchsorted(ordered, (entries[1:] + entries[:-1]) / 2.0)
        ends = np.concatenate([[0], cuts, [len(ordered)]])
        size = np.diff(ends)
        entries = np.sort(np.where(size > 0, np.diff(sums[ends]) / np.maximum(size, 1), entries))
    return np.asarray(entries, np.float32)


def nearest_entry(values: F32, codebook: F32) -> NDArray[np.uint8]:
    """Return the index of the nearest entry of an ascending codebook, in the shape of the values."""
    middles = (codebook[1:].astype(np.float64) + codebook[:-1]) / 2.0
    return np.searchsorted(middles, values).astype(np.uint8)


def palette_of(vectors: F32, entries: int) -> tuple[F32, NDArray[np.int64]]:
    """Return at most `entries` vectors that represent all vectors, and the index of the one that represents each.

    Two levels: about sqrt(entries) groups, then each group on its own with a share of the entries by its squared error.
    This is a hundred times faster than flat k-means with 65,536 centers, at a slightly larger error.

    Args:
        vectors: (N, F), N >= 1.
        entries: Size of the palette, at least 1.

    Returns:
        palette: (P, F) float32, P <= entries.
        labels: (N,) int64 indices into the palette.
    """
    distinct, inverse = distinct_rows(vectors)
    if len(distinct) <= entries:
        return distinct, inverse
    rng = np.random.default_rng(0)
    groups = max(1, round(entries**0.5))
    sample = vectors if len(vectors) <= _SAMPLE else vectors[rng.choice(len(vectors), _SAMPLE, replace=False)]
    _, group = _assign(vectors, _lloyd(sample, groups, rng))
    order = np.argsort(group, kind="stable")
    ends = np.concatenate([[0], np.cumsum(np.bincount(group, minlength=groups))])
    members = [order[a:b] for a, b in pairwise(ends) if b > a]
    shares = _shares([float(np.var(vectors[rows], axis=0).sum() * len(rows)) for rows in members], members, entries)
    palette = []
    labels = np.empty(len(vectors), np.int64)
    used = 0
    for rows, share in zip(members, shares, strict=True):
        centers = _lloyd(vectors[rows], share, rng)
        labels[rows] = used + _assign(vectors[rows], centers)[1]
        palette.append(centers)
        used += len(centers)
    return np.concatenate(palette), labels


def distinct_rows(vectors: NDArray[Number]) -> tuple[NDArray[Number], NDArray[np.int64]]:
    """Return the distinct rows of (N, F), and the index of each row among them; rows are compared by their bytes."""
    row = np.dtype((np.void, vectors.dtype.itemsize * vectors.shape[1]))
    packed = np.ascontiguousarray(vectors).view(row)[:, 0]
    _, first, inverse = np.unique(packed, return_index=True, return_inverse=True)
    return vectors[first], inverse.reshape(-1)


def _shares(errors: list[float], members: list[NDArray[np.int64]], entries: int) -> list[int]:
    """Return the number of entries of each group: from 1 to its number of members, `entries` in total at most."""
    total = sum(errors) or 1.0
    spare = entries - len(errors)
    return [1 + min(len(rows) - 1, int(spare * error / total)) for error, rows in zip(errors, members, strict=True)]


def _lloyd(vectors: F32, entries: int, rng: np.random.Generator) -> F32:
    """Return (entries, F) centers of k-means from a random start."""
    centers: F32 = vectors[rng.choice(len(vectors), min(entries, len(vectors)), replace=False)].copy()
    if len(centers) == len(vectors):
        return centers
    for _ in range(_ROUNDS):
        distance, label = _assign(vectors, centers)
        size = np.bincount(label, minlength=len(centers))
        order = np.argsort(label, kind="stable")
        filled = size > 0
        starts = (np.cumsum(size) - size)[filled]
        centers[filled] = np.add.reduceat(vectors[order], starts, axis=0) / size[filled, None]
        centers[~filled] = vectors[np.argsort(-distance, kind="stable")[: int((~filled).sum())]]
    return centers


def _assign(vectors: F32, centers: F32) -> tuple[F32, NDArray[np.int64]]:
    """Return (N,) squared distances to the nearest center, and its index."""
    half = 0.5 * np.einsum("ij,ij->i", centers, centers)
    label = np.empty(len(vectors), np.int64)
    score = np.empty(len(vectors), np.float32)
    rows = max(1, _BLOCK // len(centers))
    for start in range(0, len(vectors), rows):
        some = slice(start, start + rows)
        against = vectors[some] @ centers.T
        against -= half
        label[some] = against.argmax(axis=1)
        score[some] = against.max(axis=1)
    distance = np.einsum("ij,ij->i", vectors, vectors) - 2.0 * score
    return np.maximum(distance, 0.0).astype(np.float32), label
