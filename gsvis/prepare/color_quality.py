"""Measure SRBF colors: compare their images with those of the SH colors, in views that the fit did not use.

Images are clipped to [0, 1]. Four variants are drawn: all terms, base colors alone, the first terms of each Gaussian,
and the terms that are active at an epsilon. Memory holds one view at a time.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsvis import _check
from gsvis._extras import has, remedy_of
from gsvis.color.activation import Activation
from gsvis.color.epsilon import DEFAULT_EPSILON
from gsvis.color.evaluate import Evaluator
from gsvis.color.srbf import SrbfColors
from gsvis.errors import BackendError
from gsvis.progress import Progress, silent
from gsvis.pvs.quality import PSNR_CAP
from gsvis.render import flip, psnr, rasterize, ssim, view_weights
from gsvis.render.fixed_view import FixedView
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians

__all__ = ["EPSILONS", "PSNR_CAP", "ColorQuality", "ColorQualityConfig", "measure_colors"]

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

_VISIBLE = np.float32(1.0 / 255.0)  # least blending weight of a Gaussian that an eye sees
_MANY = 5  # active terms of a Gaussian from which they are not counted apart

EPSILONS = (0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2)
"""Epsilons at which the share of active terms is measured; the paper's epsilons are 0.01 to 0.05."""


@dataclass(frozen=True)
class ColorQualityConfig:
    """Options of a measurement of colors.

    Args:
        counts: Numbers of first terms of each Gaussian to draw. 0 and the largest number of terms of a Gaussian are
            always measured; larger counts are left out.
        epsilons: Epsilons at which activation is measured, each in (0, 1].
        flip: Also measure FLIP; needs the package flip-evaluator.

    Raises:
        ValueError: If a value is out of range.
    """

    counts: tuple[int, ...] = (1, 2, 3, 4, 6, 8, 12, 16)
    epsilons: tuple[float, ...] = EPSILONS
    flip: bool = True

    def __post_init__(self) -> None:
        for count in self.counts:
            _check.positive_int("counts", count, at_least=0)
        if not all(0.0 < epsilon <= 1.0 for epsilon in self.epsilons):
            raise ValueError(f"epsilons: expected values in (0, 1], got {self.epsilons}")


@dataclass(frozen=True, eq=False)
class Likeness:
    """The likeness of images of C views to those of the SH colors.

    Attributes:
        psnr: (C,) dB; `PSNR_CAP` for equal images.
        ssim: (C,); 1 for equal images.
        flip: (C,) mean FLIP error; None if it was not measured.
    """

    psnr: F64
    ssim: F64
    flip: F64 | None

    def as_dict(self) -> dict[str, Any]:
        """Return mean and worst of each measure."""
        found = {
            "psnr": {"mean": float(self.psnr.mean()), "worst": float(self.psnr.min())},
            "ssim": {"mean": float(self.ssim.mean()), "worst": float(self.ssim.min())},
        }
        if self.flip is not None:
            found["flip"] = {"mean": float(self.flip.mean()), "worst": float(self.flip.max())}
        return found


@dataclass(frozen=True, eq=False)
class ColorQuality:
    """The measured quality of SRBF colors in C views.

    Attributes:
        cameras: The views.
        all_terms: Likeness with all terms.
        base_only: Likeness with the base colors alone.
        counts: (K,) numbers of first terms of each Gaussian that were drawn.
        mean_terms: (K,) mean number of terms drawn for a Gaussian.
        psnr_by_count: (K, C) PSNR against SH, dB.
        epsilons: (E,) contributions above which terms are active.
        active_shares: (E, C) share of all terms that are active for the eye of each view; 0 if there are no terms.
        active_psnr: (E, C) PSNR of active terms against all terms, dB.
        by_active: (6,) share of the Gaussians that an eye sees with 0, 1, ... 4 and more terms active at
            `DEFAULT_EPSILON`, mean over the views.
        config: Options of the measurement.
    """

    cameras: Cameras
    all_terms: Likeness
    base_only: Likeness
    counts: NDArray[np.int64]
    mean_terms: F64
    psnr_by_count: F64
    epsilons: F64
    active_shares: F64
    active_psnr: F64
    by_active: F64
    config: ColorQualityConfig = field(default_factory=ColorQualityConfig)

    def as_dict(self) -> dict[str, Any]:
        """Return the measurements as plain numbers, strings and lists for JSON."""
        looked = self.cameras
        rows = [
            {
                "eye": looked.viewpoints[c].tolist(),
                "psnr": float(self.all_terms.psnr[c]),
                "ssim": float(self.all_terms.ssim[c]),
                "flip": None if self.all_terms.flip is None else float(self.all_terms.flip[c]),
                "base_psnr": float(self.base_only.psnr[c]),
            }
            for c in range(len(looked))
        ]
        return {
            "views": len(looked),
            "width": looked.width,
            "height": looked.height,
            "psnr_cap": PSNR_CAP,
            "all_terms": self.all_terms.as_dict(),
            "base_only": self.base_only.as_dict(),
            "by_count": [
                {"first": int(k), "mean_terms": float(m), "psnr": float(row.mean()), "psnr_worst": float(row.min())}
                for k, m, row in zip(self.counts, self.mean_terms, self.psnr_by_count, strict=True)
            ],
            "active": [
                {"epsilon": float(e), "share": float(s.mean()), "psnr": float(p.mean()), "psnr_worst": float(p.min())}
                for e, s, p in zip(self.epsilons, self.active_shares, self.active_psnr, strict=True)
            ],
            "visible_by_active": {"epsilon": DEFAULT_EPSILON, "shares": self.by_active.tolist()},
            "cameras": rows,
            "config": asdict(self.config),
        }


def measure_colors(
    g: Gaussians,
    colors: SrbfColors,
    cameras: Cameras,
    config: ColorQualityConfig | None = None,
    *,
    progress: Progress = silent,
) -> ColorQuality:
    """Measure how alike views drawn with SH colors and with SRBF colors are.

    Args:
        g: N Gaussians with their SH colors.
        colors: SRBF colors of these Gaussians.
        cameras: C > 0 views that the fit did not use.
        config: Options; None means `ColorQualityConfig()`.
        progress: Called with stage "colors", in views.

    Raises:
        ValueError: If lengths differ or there is no camera.
        BackendError: If `config.flip` is set and the package flip-evaluator is missing.
    """
    config = config or ColorQualityConfig()
    if len(g) != len(colors):
        raise ValueError(f"colors: expected those of {len(g):,} Gaussians, got {len(colors):,}")
    if len(cameras) == 0:
        raise ValueError("cameras: expected at least one, got none")
    most = int(colors.counts.max(initial=0))
    counts = np.array(sorted({0, most, *(k for k in config.counts if k < most)}), np.int64)
    ranks = colors.ranks
    evaluator = Evaluator(colors)
    activation = Activation(colors, g.means, 0.0)
    drawn = g.without_harmonics()
    measured: dict[str, list[Any]] = {name: [] for name in ("all", "base", "count", "share", "active", "by")}
    progress("colors", 0, len(cameras))
    for c in range(len(cameras)):
        camera = cameras[c]
        eye = cameras[c].viewpoints[0]
        seen = FixedView(drawn, camera)

        def shown(active: NDArray[np.bool_] | None, seen: FixedView = seen) -> F32:
            """Return the image from colors with some of their terms."""
            return _clipped(seen.image(evaluator.colors(g.means, seen.eye, active=active, ids=seen.ids)))

        exact = _clipped(np.asarray(rasterize(g, camera, backend="cpu").images[0]))
        fitted = shown(None)
        firsts = {int(k): shown(ranks < k) for k in counts[:-1]} | {most: fitted}
        measured["all"].append(_likeness(fitted, exact, config.flip))
        measured["base"].append(_likeness(firsts[0], exact, config.flip))
        measured["count"].append([_psnr(firsts[int(k)], exact) for k in counts])
        contributions = activation.contributions(eye)
        measured["by"].append(_by_active(g, camera, colors, contributions > np.float32(DEFAULT_EPSILON)))
        masks = [contributions > np.float32(epsilon) for epsilon in config.epsilons]
        measured["share"].append([float(mask.mean()) if len(mask) else 0.0 for mask in masks])
        measured["active"].append([_psnr(shown(mask), fitted) for mask in masks])
        progress("colors", c + 1, len(cameras))
    mean_terms = np.array([np.minimum(colors.counts, k).mean() if len(g) else 0.0 for k in counts])
    return ColorQuality(
        cameras,
        _join(measured["all"]),
        _join(measured["base"]),
        counts,
        mean_terms,
        np.array(measured["count"]).T,
        np.array(config.epsilons),
        np.array(measured["share"]).T,
        np.array(measured["active"]).T,
        np.mean(measured["by"], axis=0),
        config,
    )


def _by_active(g: Gaussians, camera: Cameras, colors: SrbfColors, active: NDArray[np.bool_]) -> F64:
    """Return (6,) the shares of the visible Gaussians with 0, 1, ... 4 and more active terms."""
    seen = view_weights(g, camera).largest[0] >= _VISIBLE
    numbers = np.bincount(colors.gaussian_ids[active], minlength=len(colors))[seen]
    counts = np.bincount(np.minimum(numbers, _MANY), minlength=_MANY + 1)
    return np.asarray(counts / max(1, len(numbers)))


def _clipped(image: F32) -> F32:
    """Return an image clipped to [0, 1] as a display does."""
    return np.asarray(np.clip(image, 0.0, 1.0), np.float32)


def _psnr(image: F32, target: F32) -> float:
    return min(PSNR_CAP, float(psnr(image, target)))


def _likeness(image: F32, target: F32, with_flip: bool) -> tuple[float, float, float | None]:
    """Return PSNR, SSIM and, if wanted, FLIP of an image against a target."""
    alike = float(ssim(image, target, padding="same"))
    return _psnr(image, target), alike, float(flip(image, target)) if with_flip else None


def _join(rows: Sequence[tuple[float, float, float | None]]) -> Likeness:
    """Return the figures of all views as arrays."""
    psnrs, ssims, flips = zip(*rows, strict=True)
    return Likeness(np.array(psnrs), np.array(ssims), None if flips[0] is None else np.array(flips, np.float64))


def has_flip() -> bool:
    """Return whether FLIP is available here."""
    return has("flip_evaluator")


def check_flip() -> None:
    """Raise unless FLIP, which calibrates epsilon, is available.

    Raises:
        BackendError: If the package flip-evaluator is missing; with the remedy.
    """
    if not has_flip():
        raise BackendError(
            "epsilon: expected the package flip-evaluator, to calibrate it, got none;"
            f" {remedy_of('flip_evaluator')}, or give a number"
        )
