"""Store colors as a base and a few spherical radial basis functions (SRBF) per Gaussian.

Directions are unit vectors from the eye to the Gaussian, in the scene's frame, as for SH. A term is one SRBF of one
function of one Gaussian: two spherical coordinates, a decay, one or more intensities. Terms are stored Gaussian by
Gaussian, the most useful first. Nothing here knows how terms are fitted.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis import _check
from gsvis.color.variants import Variant, variant

__all__ = ["SrbfColors", "spherical_coordinates", "srbf", "unit_vectors"]

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

MAX_DECAY = 1e4


def srbf(x: ArrayLike, c: ArrayLike, decay: ArrayLike) -> F64:
    """Evaluate spherical radial basis functions: exp(decay (x . c - 1)), 1 at the center.

    Args:
        x: (..., 3) unit vectors.
        c: (..., 3) centers, unit vectors.
        decay: (...) lambda, > 0; the larger, the narrower.

    Returns:
        Values of the broadcast shape, in (0, 1].

    References:
        SRBF-Gaussian, equation 3.

    Examples:
        >>> srbf([[0, 0, 1], [1, 0, 0]], [0, 0, 1], 2.0).round(4).tolist()
        [1.0, 0.1353]
    """
    cosines = np.einsum("...i,...i->...", np.asarray(x, np.float64), np.asarray(c, np.float64))
    return np.asarray(np.exp(np.asarray(decay, np.float64) * (cosines - 1.0)))


def unit_vectors(coordinates: ArrayLike) -> F64:
    """Return (..., 3) unit vectors from (..., 2) spherical coordinates: polar angle from +z, azimuth from +x to +y."""
    theta, phi = np.moveaxis(np.asarray(coordinates, np.float64), -1, 0)
    return np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=-1)


def spherical_coordinates(vectors: ArrayLike) -> F64:
    """Return (..., 2) polar angle in [0, pi] and azimuth in [-pi, pi] of (..., 3) vectors of any length > 0."""
    x, y, z = np.moveaxis(np.asarray(vectors, np.float64), -1, 0)
    return np.stack([np.arctan2(np.hypot(x, y), z), np.arctan2(y, x)], axis=-1)


@dataclass(frozen=True, eq=False, repr=False)
class SrbfColors:
    """Colors of N Gaussians: base colors and T terms, validated, read-only.

    Args:
        variant: One of `VARIANTS`.
        base: (N, 3) base colors in the variant's space: RGB (not clipped), or HSL of RGB / `scales`.
        scales: (N,) > 0; divisor that fits RGB into its space. 1 for variants whose space is RGB.
        offsets: (N + 1,) int64; the terms of Gaussian i are offsets[i]:offsets[i + 1], in sending order.
        functions: (T,) uint8, index into the variant's functions.
        centers: (T, 2) polar angle and azimuth of the center, radians.
        decays: (T,) lambda of equation 3, > 0.
        intensities: (T, I), I given by the variant.

    Raises:
        ValueError: If a shape, an order or a value does not fit; the message names the argument.

    References:
        SRBF-Gaussian, equations 1 to 5.
    """

    variant: str
    base: F32
    scales: F32
    offsets: NDArray[np.int64]
    functions: NDArray[np.uint8]
    centers: F32
    decays: F32
    intensities: F32

    def __post_init__(self) -> None:
        kind = variant(self.variant)
        base = _check.floats("base", self.base, ("N", 3))
        n = len(base)
        offsets = _check.integers("offsets", self.offsets, (n + 1,))
        if offsets[0] != 0 or np.any(np.diff(offsets) < 0):
            raise ValueError(f"offsets: expected ascending values from 0, got {_check.not_rising(offsets, first=0)}")
        t = int(offsets[-1])
        functions = _check.integers("functions", self.functions, (t,), np.uint8)
        arrays: dict[str, NDArray[Any]] = {
            "base": base,
            "scales": _check.floats("scales", self.scales, (n,)),
            "offsets": offsets,
            "functions": functions,
            "centers": _check.floats("centers", self.centers, (t, 2)),
            "decays": _check.floats("decays", self.decays, (t,)),
            "intensities": _check.floats("intensities", self.intensities, (t, kind.intensities)),
        }
        _check.in_range("scales", arrays["scales"], 0.0, np.inf, open_low=True)
        _check.in_range("decays", arrays["decays"], 0.0, MAX_DECAY, open_low=True)
        if t and int(functions.max()) >= len(kind.functions):
            raise ValueError(
                f"functions: expected below {len(kind.functions)} for {kind.name!r}, got {functions.max()}"
            )
        for name, array in arrays.items():
            view = array.view()
            view.flags.writeable = False
            object.__setattr__(self, name, view)

    @classmethod
    def without_terms(cls, rgb: ArrayLike) -> SrbfColors:
        """Return colors without view dependence, as the `rgb` variant.

        Args:
            rgb: (N, 3) colors.
        """
        base = _check.floats("rgb", rgb, ("N", 3))
        n = len(base)
        counts = np.zeros(n + 1, np.int64)
        none = np.zeros(0, np.float32)
        functions = np.zeros(0, np.uint8)
        pairs = none.reshape(0, 2)
        triples = none.reshape(0, 3)
        ones = np.ones(n, np.float32)
        return cls("rgb", base, ones, counts, functions, pairs, none, triples)

    def __len__(self) -> int:
        return len(self.base)

    def __repr__(self) -> str:
        return f"SrbfColors({self.variant!r}, {len(self):,} Gaussians, {self.num_terms:,} terms)"

    @property
    def kind(self) -> Variant:
        """The variant's definition."""
        return variant(self.variant)

    @property
    def num_terms(self) -> int:
        """Number of terms, T."""
        return len(self.functions)

    @property
    def counts(self) -> NDArray[np.int64]:
        """(N,) number of terms of each Gaussian over all its functions."""
        return np.diff(self.offsets)

    @property
    def gaussian_ids(self) -> NDArray[np.int64]:
        """(T,) index of the Gaussian of each term."""
        return np.repeat(np.arange(len(self)), self.counts)

    @property
    def ranks(self) -> NDArray[np.int64]:
        """(T,) rank of each term within its Gaussian, from 0."""
        return np.arange(self.num_terms) - np.repeat(self.offsets[:-1], self.counts)

    def amplitudes(self) -> F32:
        """Return (T, 3), the amount that each term adds to the base, in the variant's space, where its SRBF is 1."""
        kind = self.kind
        if not kind.components:
            return self.intensities
        component = np.asarray(kind.components, np.int64)[self.functions]
        added = np.zeros((self.num_terms, 3), np.float32)
        added[np.arange(self.num_terms), component] = self.intensities[:, 0] * self.base[self.gaussian_ids, component]
        return added

    def __getitem__(self, index: Any) -> SrbfColors:
        """Select the colors of Gaussians by a slice, a mask, an index array, or one integer."""
        if isinstance(index, int | np.integer):
            index = np.asarray([index])
        is_slice = isinstance(index, slice)
        chosen = np.arange(*index.indices(len(self))) if is_slice else np.arange(len(self))[index]
        counts = self.counts[chosen]
        offsets = np.concatenate([np.zeros(1, np.int64), np.cumsum(counts)])
        terms = np.arange(offsets[-1]) + np.repeat(self.offsets[chosen] - offsets[:-1], counts)
        return SrbfColors(
            self.variant,
            self.base[chosen],
            self.scales[chosen],
            offsets,
            self.functions[terms],
            self.centers[terms],
            self.decays[terms],
            self.intensities[terms],
        )

    def keep(self, terms: ArrayLike) -> SrbfColors:
        """Return the same Gaussians with some of their terms, in the same order.

        Args:
            terms: (T,) bool, the terms to keep.

        Raises:
            ValueError: If it is not a mask of T terms.
        """
        mask = np.asarray(terms)
        if mask.dtype != bool or mask.shape != (self.num_terms,):
            raise ValueError(f"terms: expected bool of shape ({self.num_terms},), got {mask.dtype} of {mask.shape}")
        kept = np.concatenate([np.zeros(1, np.int64), np.cumsum(mask, dtype=np.int64)])
        return SrbfColors(
            self.variant,
            self.base,
            self.scales,
            kept[self.offsets],
            self.functions[mask],
            self.centers[mask],
            self.decays[mask],
            self.intensities[mask],
        )

    def first(self, count: int) -> SrbfColors:
        """Return the first terms of each Gaussian: 0 leaves the base colors, more refine them.

        Args:
            count: Maximum number of terms to keep for each Gaussian.
        """
        return self.keep(self.ranks < _check.positive_int("count", count, at_least=0))
