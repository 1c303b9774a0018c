"""Fit colors of which one number varies with direction: the rows of the paper's table 3 that no package holds.

`hsl-l` and `hsv` hold the hue and the saturation of the mean color, `yuv` its two color differences. What varies is the
lightness, the value or the luma, as a base and terms of orthogonal matching pursuit. Colors of a Gaussian are divided
by its largest channel first, so that they fit the space. Directions run from the eye to the Gaussian. Terms stay on
the atoms that the pursuit picks; `fit_srbf`, which fits the rows beside these, also moves its terms.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis.color import hsl_to_rgb, orthogonal_matching_pursuit, rgb_to_hsl, srbf, srbf_dictionary
from gsvis.color.fit import face_weights, sample_colors
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.icosphere import face_directions, face_shares, icosphere

__all__ = ["HELD", "HeldColors", "fit_held"]

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

HELD = ("hsl-l", "hsv", "yuv")
DECAYS = (1.5, 6.0)
_LUMA = np.array([0.299, 0.587, 0.114])
_CHUNK = 2048


@dataclass(frozen=True, eq=False)
class HeldColors:
    """Colors of N Gaussians with T terms.

    Attributes:
        name: One of `HELD`.
        held: (N, 3) RGB; for "yuv" of luma 0, else the color at value 1 or lightness 1/2.
        base: (N,) number that varies, without terms, of colors over `scales`.
        scales: (N,) divisors of the colors.
        counts: (N,) terms of each Gaussian.
        centers: (T, 3) unit vectors.
        decays: (T,).
        intensities: (T,) what each term adds to the number where its lobe is 1.
    """

    name: str
    held: F64
    base: F64
    scales: F64
    counts: NDArray[np.int64]
    centers: F64
    decays: F64
    intensities: F64

    def __len__(self) -> int:
        return len(self.base)

    def colors(self, means: ArrayLike, eye: ArrayLike) -> NDArray[np.float32]:
        """Return (N, 3) RGB as an eye (3,) sees Gaussians with centers (N, 3)."""
        ways = np.asarray(means, np.float64) - np.asarray(eye, np.float64)
        ways /= np.maximum(np.linalg.norm(ways, axis=1, keepdims=True), 1e-300)
        ids = np.repeat(np.arange(len(self)), self.counts)
        added = self.intensities * srbf(ways[ids], self.centers, self.decays)
        values = self.base + np.bincount(ids, added, len(self))
        return self._rgb(values)

    def nearest(self, colors: ArrayLike) -> NDArray[np.float32]:
        """Return (N, 3) RGB nearest to given colors (N, 3) that these Gaussians could show with any terms."""
        scaled = np.asarray(colors, np.float64) / self.scales[:, None]
        return self._rgb(_nearest(self.name, self.held, scaled[:, :, None])[0][:, 0])

    def _rgb(self, values: F64) -> NDArray[np.float32]:
        rgb = _shown(self.name, self.held, values[:, None])[:, :, 0]
        return np.asarray(np.maximum(rgb, 0.0) * self.scales[:, None], np.float32)


def fit_held(
    g: Gaussians, directions: ArrayLike, name: str, mean_terms: float, max_terms: int, importance: ArrayLike
) -> HeldColors:
    """Fit the colors of a scene.

    Args:
        g: N Gaussians.
        directions: Direction sets, as `fit_srbf` takes them.
        name: One of `HELD`.
        mean_terms: Mean number of terms; they go where they lower the error times importance most.
        max_terms: Maximum number of terms of a Gaussian.
        importance: (N,) weight of the error of each Gaussian.
    """
    points = -face_directions(4).reshape(-1, 3)
    dictionary = srbf_dictionary(points, icosphere(2)[0], DECAYS)
    faces = face_weights(directions, len(g))
    share = np.asarray(importance, np.float64)
    slices = [slice(start, start + _CHUNK) for start in range(0, len(g), _CHUNK)]
    signals = [_signals(g[part], faces[part], name) for part in slices]
    costs = [
        share[part, None]
        * orthogonal_matching_pursuit(dictionary.values, targets, max_terms=max_terms, weights=weights).errors
        / weights.sum(axis=1, keepdims=True)
        for part, (_, _, _, targets, weights) in zip(slices, signals, strict=True)
    ]
    counts = _choose_counts(np.concatenate(costs), mean_terms)
    atoms: list[NDArray[np.int32]] = []
    intensities: list[NDArray[np.float32]] = []
    for part, (_, _, _, targets, weights) in zip(slices, signals, strict=True):
        codes = orthogonal_matching_pursuit(dictionary.values, targets, max_terms=counts[part], weights=weights)
        chosen = codes.atoms >= 0
        counts[part] = codes.counts
        atoms.append(codes.atoms[chosen])
        intensities.append(codes.coefficients[chosen])
    which = np.concatenate(atoms)
    return HeldColors(
        name=name,
        held=np.concatenate([held for held, *_ in signals]),
        base=np.concatenate([base for _, base, *_ in signals]),
        scales=np.concatenate([scales for _, _, scales, *_ in signals]),
        counts=counts,
        centers=dictionary.centers[which],
        decays=dictionary.decays[which],
        intensities=np.concatenate(intensities).astype(np.float64),
    )


def _signals(g: Gaussians, faces: NDArray[np.float32], name: str) -> tuple[F64, F64, F64, F32, F32]:
    """Return held colors, bases, scales, and the numbers over directions (n, D) less the base, with their weights."""
    weights = (faces[:, :, None] * face_shares(4)).reshape(len(faces), -1).astype(np.float64)
    weights[weights.max(axis=1) <= 0.0] = 1.0
    colors = sample_colors(g).astype(np.float64)
    scales = np.where(weights > 0.0, colors.max(axis=1), 0.0).max(axis=1)
    scales = np.where(scales > 0.0, scales, 1.0)
    colors /= scales[:, None, None]
    mean = np.einsum("ncd,nd->nc", colors, weights) / weights.sum(axis=1, keepdims=True)
    if name == "yuv":
        held = mean - (mean @ _LUMA)[:, None]
    elif name == "hsv":
        most = mean.max(axis=1, keepdims=True)
        held = np.where(most > 0.0, mean / np.maximum(most, 1e-12), 1.0)  # black on all sides has no tint
    else:
        held = hsl_to_rgb(np.concatenate([rgb_to_hsl(np.clip(mean, 0.0, 1.0))[:, :2], np.full((len(g), 1), 0.5)], 1))
    values, slopes = _nearest(name, held, colors)
    effect = weights * slopes * scales[:, None] ** 2  # weight of an error in RGB
    base = (effect * values).sum(axis=1) / np.maximum(effect.sum(axis=1), 1e-300)
    targets = (values - base[:, None]).astype(np.float32)
    return held, base, scales, targets, np.maximum(effect, 1e-12 * (weights > 0.0)).astype(np.float32)


def _nearest(name: str, held: F64, colors: F64) -> tuple[F64, F64]:
    """Return the number (n, D) whose color is nearest to each color (n, 3, D), and the squared RGB step of one unit."""
    if name == "yuv":
        return (colors - held[:, :, None]).mean(axis=1), np.full((len(held), colors.shape[2]), 3.0)
    if name == "hsv":
        squares = np.square(held).sum(axis=1)[:, None]
        return np.einsum("nc,ncd->nd", held, colors) / squares, np.broadcast_to(squares, colors[:, 0].shape)
    low = 2.0 * held[:, :, None]  # color of a lightness up to 1/2: L low; above: (2 L - 1) + 2 (1 - L) held
    high = 2.0 - low
    sizes = [np.maximum(np.square(part).sum(axis=1), 1e-12) for part in (low, high)]
    dark = np.clip((low * colors).sum(axis=1) / sizes[0], 0.0, 0.5)
    light = np.clip((high * (colors - low + 1.0)).sum(axis=1) / sizes[1], 0.5, 1.0)
    errors = [np.square(_shown(name, held, values) - colors).sum(axis=1) for values in (dark, light)]
    darker = errors[0] <= errors[1]
    return np.where(darker, dark, light), np.where(darker, *sizes)


def _shown(name: str, held: F64, values: F64) -> F64:
    """Return the RGB (n, 3, D) of numbers (n, D), not clipped below."""
    numbers = values[:, None]
    if name == "yuv":
        return np.asarray(held[:, :, None] + numbers)
    numbers = np.clip(numbers, 0.0, 1.0)
    if name == "hsv":
        return np.asarray(held[:, :, None] * numbers)
    gray = np.maximum(2.0 * numbers - 1.0, 0.0)
    return np.asarray(gray + 2.0 * np.minimum(numbers, 1.0 - numbers) * held[:, :, None])


def _choose_counts(costs: F64, mean_terms: float) -> NDArray[np.int64]:
    """Return (N,) numbers of terms at the least price at which they are at most `mean_terms` on average."""
    terms = np.arange(costs.shape[1])
    low, high = 1e-300, float(costs[:, 0].max()) + 1e-300
    for _ in range(200):
        price = np.sqrt(low) * np.sqrt(high)
        low, high = (price, high) if (costs + price * terms).argmin(axis=1).mean() > mean_terms else (low, price)
    return np.asarray((costs + high * terms).argmin(axis=1))
