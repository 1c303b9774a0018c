"""Find the terms of a slice of Gaussians, separately for each function of the variant, as many as the price allows."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from gsvis.color._kernels import fit as kernels
from gsvis.color._split import Function, Split, split_colors
from gsvis.color.omp import SparseCodes, orthogonal_matching_pursuit
from gsvis.color.variants import VARIANTS
from gsvis.scene.icosphere import face_directions, icosphere

if TYPE_CHECKING:
    from gsvis.color.fit import FitConfig

__all__ = ["LobeFit", "Pursuit", "SplitFit"]

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

_LEAST_DECAY = 0.1
_MOST_DECAY = 60.0
"""Range of decays: from a nearly linear lobe to one narrower than a face (half width 9 degrees)."""


@dataclass(frozen=True, eq=False)
class LobeFit:
    """Lobes of one function of n Gaussians.

    Attributes:
        v: (n, K, 3) decay times center, eye to Gaussian, in sending order.
        intensities: (n, K, C) in the units of the targets.
        counts: (n,) number of lobes worth their price.
        curves: (n, K + 1) weighted mean squared RGB error with 0, 1, ... lobes.
        wide: (n, K + 1) sum of their widths: the weighted share of directions along which a lobe changes a channel by
            more than epsilon.
    """

    v: F32
    intensities: F32
    counts: NDArray[np.int64]
    curves: F32
    wide: F32


@dataclass(frozen=True, eq=False)
class SplitFit:
    """Input and result of a fit.

    Attributes:
        colors: (n, 3, D) RGB.
        weights: (n, D).
        split: Bases and functions.
        lobes: Lobes of each function.
    """

    colors: F32
    weights: F32
    split: Split
    lobes: tuple[LobeFit, ...]

    def curves(self, importance: F64) -> list[tuple[F64, F64]]:
        """Return, for each function, (n, K + 1) importance times error and sum of widths, with 0, 1, ... lobes."""
        return [
            (importance[:, None] * lobe.curves.astype(np.float64), lobe.wide.astype(np.float64)) for lobe in self.lobes
        ]


class Pursuit:
    """Fit terms with the dictionary and the limits of a config.

    Args:
        config: Variant and effort.
    """

    def __init__(self, config: FitConfig) -> None:
        self.config = config
        self.kind = VARIANTS[config.variant]
        centers = icosphere(1 if config.refine else 2)[0]
        decays = np.asarray(config.atom_decays, np.float64)
        self.starts = (decays[:, None, None] * centers).reshape(-1, 3)
        towards_gaussian = -face_directions(4).reshape(-1, 3)
        exponents = self.starts @ towards_gaussian.T - np.repeat(decays, len(centers))[:, None]
        self.dictionary = np.exp(exponents).astype(np.float32)
        self.directions = np.ascontiguousarray(towards_gaussian.T, np.float32)
        self.limits = (
            config.ridge,
            _LEAST_DECAY,
            _MOST_DECAY,
            config.tolerance,
            float(config.steps),
            config.emphasis,
            config.width_price,
            config.epsilon,
        )

    def fit(self, colors: F32, weights: F32, importance: F64, price: float, nowhere: NDArray[np.bool_]) -> SplitFit:
        """Find the terms of n Gaussians.

        Args:
            colors: (n, 3, D) RGB >= 0.
            weights: (n, D) >= 0, some above 0 in each row.
            importance: (n,) weight of an error.
            price: Least decrease of importance times error that a term must achieve.
            nowhere: (n,) True for Gaussians that no direction sees; they get no terms.
        """
        split = split_colors(self.kind, colors.copy(), weights)
        most = np.where(nowhere, 0, self.config.max_terms)
        search = self._refine if self.config.refine else self._choose_atoms
        lobes = tuple(search(f, importance, price, np.where(f.unit != 0, most, 0)) for f in split.functions)
        return SplitFit(colors, weights, split, lobes)

    def _refine(self, function: Function, importance: F64, price: float, most: NDArray[np.int64]) -> LobeFit:
        """Return lobes that were refined after each choice."""
        n, channels, _ = function.targets.shape
        k = self.config.max_terms
        found = LobeFit(
            np.zeros((n, k, 3), np.float32),
            np.zeros((n, k, channels), np.float32),
            np.zeros(n, np.int64),
            np.zeros((n, k + 1), np.float32),
            np.zeros((n, k + 1), np.float32),
        )
        kernels.fit_lobes(
            self.directions,
            self.dictionary,
            self.starts,
            function.targets,
            function.weights,
            importance,
            most,
            price,
            self.limits,
            found.v,
            found.intensities,
            found.counts,
            found.curves,
            found.wide,
        )
        return found

    def _choose_atoms(self, function: Function, importance: F64, price: float, most: NDArray[np.int64]) -> LobeFit:
        """Return lobes that stay on the atoms which matching pursuit chooses."""
        seen = (function.weights > 0).sum(axis=1)
        codes = orthogonal_matching_pursuit(
            self.dictionary.T,
            function.targets.transpose(0, 2, 1),
            max_terms=np.minimum(most, seen // 4),
            weights=function.weights,
        )
        total = np.maximum(function.weights.sum(axis=1, dtype=np.float64), 1e-300)[:, None]
        curves = (codes.errors / total).astype(np.float32)
        n = len(most)
        k = self.config.max_terms
        curves = np.pad(curves, ((0, 0), (0, k + 1 - curves.shape[1])), mode="edge")
        wide = self._widths(function, codes)
        costs = importance[:, None] * curves.astype(np.float64)
        costs += price * (np.arange(k + 1) + self.config.width_price * wide)
        counts = np.minimum(costs.argmin(axis=1), codes.counts)
        v = np.zeros((n, k, 3), np.float32)
        v[:, : codes.atoms.shape[1]] = self.starts[codes.atoms]
        intensities = np.zeros((n, k, function.targets.shape[1]), np.float32)
        kernels.settle_lobes(
            self.directions,
            function.targets,
            function.weights,
            self.limits,
            counts,
            v,
            intensities,
            np.empty(n, np.float32),
        )
        return LobeFit(v, intensities, counts, curves, wide)

    def _widths(self, function: Function, codes: SparseCodes) -> F32:
        """Return (n, K + 1) sums of the widths of 0, 1, ... atoms, in the order of choice."""
        n, most = codes.atoms.shape
        wide = np.zeros((n, self.config.max_terms + 1), np.float32)
        total = np.maximum(function.weights.sum(axis=1), np.float32(1e-30))
        for k in range(most):
            sizes = np.abs(codes.coefficients[:, k]).max(axis=1) / np.float32(self.config.epsilon)
            changed = sizes[:, None] * self.dictionary[codes.atoms[:, k]] > 1.0
            wide[:, k + 1] = wide[:, k] + (function.weights * changed).sum(axis=1) / total
        wide[:, most + 1 :] = wide[:, most : most + 1]
        return wide
