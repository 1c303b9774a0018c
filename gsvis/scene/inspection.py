"""Inspect a scene: counts, bounds, the likely up axis, quantiles, problems.

Frame and units are the scene's own. Everything here is an estimate from the Gaussians alone. This module knows no
file and no renderer. It is deterministic: the same scene gives the same report.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsvis.scene.gaussians import Gaussians

__all__ = ["SceneReport", "axis_vector", "guess_up", "has_no_floaters", "inspect_scene"]

F64 = NDArray[np.float64]

AXES = ("+x", "-x", "+y", "-y", "+z", "-z")
MIN_ALPHA = 1.0 / 255.0  # docs/conventions.md
FLOATER_EXTENT = 5.0  # in sizes of the robust box, about its middle
_QUANTILES = {"min": 0.0, "p1": 0.01, "p10": 0.1, "p50": 0.5, "p90": 0.9, "p99": 0.99, "max": 1.0}
_ALIGNED = np.cos(np.radians(20.0))
# Log odds of each up axis among published scenes: COLMAP gives -y, viewers +y, scanners and CAD +z.
_PRIOR = {"+x": -0.3, "-x": -0.3, "+y": 0.15, "-y": 0.3, "+z": 0.15, "-z": -0.3}


@dataclass(frozen=True)
class SceneReport:
    """Results of `inspect_scene`. Lengths are in scene units, shares are of all Gaussians, in [0, 1].

    Args:
        count: Number of Gaussians.
        sh_degree: 0 to 3.
        bytes_in_memory: Bytes of the arrays.
        bounds: Lowest and highest corner of the box of all centers; empty for an empty scene.
        robust_bounds: The same for the middle 98% of the centers on each axis.
        up: Likely up axis, such as "+z".
        up_confidence: In (0, 1].
        opacities: Quantiles of the opacities by name.
        scales: Quantiles of the largest standard deviation of each Gaussian by name.
        invisible_share: Share with an opacity below 1/255.
        opaque_share: Share with an opacity of at least one half.
        floaters: Number of centers outside 5 times the robust box.
        farthest: Distance of the farthest center from the middle of the robust box, in diagonals of the box.
        duplicates: Number of Gaussians whose place, shape and opacity equal an earlier one's.
        needle_share: Share with a largest scale more than 10 times the middle one.
        disc_share: Share, without needles, with a smallest scale less than a tenth of the middle one.
        giant_share: Share with a largest scale more than a tenth of the robust box's longest side.
        problems: Likely problems, one sentence each; empty if there are none.
    """

    count: int
    sh_degree: int
    bytes_in_memory: int
    bounds: list[list[float]]
    robust_bounds: list[list[float]]
    up: str
    up_confidence: float
    opacities: dict[str, float]
    scales: dict[str, float]
    invisible_share: float
    opaque_share: float
    floaters: int
    farthest: float
    duplicates: int
    needle_share: float
    disc_share: float
    giant_share: float
    problems: list[str]

    def as_dict(self) -> dict[str, Any]:
        """Return the report as plain numbers, strings and lists, ready for JSON."""
        return asdict(self)


def inspect_scene(g: Gaussians, *, up: str | None = None) -> SceneReport:
    """Count, measure and check a scene.

    Args:
        g: The scene; may be empty.
        up: The up axis where it is known, such as "+z"; None guesses.

    Returns:
        The report; `problems` lists what to check first.
    """
    up, confidence = guess_up(g) if up is None else (up, 1.0)
    if len(g) == 0:
        zeros = dict.fromkeys(_QUANTILES, 0.0)
        return SceneReport(
            0, g.sh_degree, 0, [], [], up, confidence, zeros, zeros, *(0.0, 0.0), 0, 0.0, 0, *(0.0, 0.0, 0.0),
            problems=["the scene has no Gaussians"],
        )  # fmt: skip
    robust = g.bounds(0.98)
    middle, half = robust.mean(axis=0), 0.5 * (robust[1] - robust[0])
    away = np.abs(g.means.astype(np.float64) - middle)
    diagonal = 2.0 * float(np.linalg.norm(half))
    least, mid, most = np.sort(g.scales, axis=1).T
    needle = most > 10.0 * mid
    report = SceneReport(
        count=len(g),
        sh_degree=g.sh_degree,
        bytes_in_memory=g.nbytes,
        bounds=g.bounds(1.0).tolist(),
        robust_bounds=robust.tolist(),
        up=up,
        up_confidence=confidence,
        opacities=_quantiles(g.opacities),
        scales=_quantiles(most),
        invisible_share=float(np.mean(g.opacities < MIN_ALPHA)),
        opaque_share=float(np.mean(g.opacities >= 0.5)),
        floaters=int(np.count_nonzero(np.any(away > FLOATER_EXTENT * half, axis=1))) if diagonal > 0.0 else 0,
        farthest=float(np.linalg.norm(away, axis=1).max()) / diagonal if diagonal > 0.0 else 0.0,
        duplicates=_count_duplicates(g),
        needle_share=float(np.mean(needle)),
        disc_share=float(np.mean(~needle & (least < 0.1 * mid))),
        giant_share=float(np.mean(most > 0.2 * half.max())) if diagonal > 0.0 else 0.0,
        problems=[],
    )
    return replace(report, problems=list(_problems(report, g)))


def _quantiles(values: NDArray[np.float32]) -> dict[str, float]:
    found = np.quantile(values.astype(np.float64), list(_QUANTILES.values()))
    return dict(zip(_QUANTILES, found.tolist(), strict=True))


def _count_duplicates(g: Gaussians) -> int:
    """Count the Gaussians that repeat an earlier one bit for bit, by a 64-bit hash of place, shape and opacity."""
    mixed = np.zeros(len(g), np.uint64)
    for column in (*g.means.T, *g.scales.T, *g.quats.T, g.opacities):
        mixed ^= np.ascontiguousarray(column).view(np.uint32)
        mixed *= np.uint64(0x9E3779B97F4A7C15)
        mixed ^= mixed >> np.uint64(29)
    return len(g) - len(np.unique(mixed))


def _problems(r: SceneReport, g: Gaussians) -> Iterator[str]:
    """Yield likely problems, the most important first."""
    low, high = np.array(r.robust_bounds)
    longest = float((high - low).max())
    if r.floaters:
        yield (
            f"{_some(r.floaters)} outside {FLOATER_EXTENT:g} times the robust box, the farthest {r.farthest:,.0f}"
            " scene sizes away; gsvis clean removes them"
        )
    if r.invisible_share > 0.1:
        yield f"{r.invisible_share:.0%} of the Gaussians have an opacity below 1/255 and can never be seen; drop them"
    yield from _value_problems(r, g, longest)
    if r.giant_share > 0.01:
        yield f"{r.giant_share:.1%} of the Gaussians are wider than a tenth of the scene"
    if r.needle_share > 0.4:
        yield f"{r.needle_share:.0%} of the Gaussians are needles, more than 10 times as long as wide"
    if r.duplicates:
        yield f"{_some(r.duplicates, 'repeat', 'repeats')} an earlier one exactly"
    if longest == 0.0:
        yield "all robust centers coincide"
    elif longest > 1000.0 or longest < 0.1:
        unit = "meters are unlikely; millimeters or map units?" if longest > 1000.0 else "meters are unlikely"
        yield f"the scene is {longest:.3g} units long: {unit}"
    if r.up_confidence < 0.6:
        yield f"the up axis is uncertain ({r.up} with a confidence of {r.up_confidence:.0%}); verify it"


def _value_problems(r: SceneReport, g: Gaussians, longest: float) -> Iterator[str]:
    """Yield values that suggest a wrong activation on import."""
    many = r.count >= 100
    if many and r.opacities["min"] == r.opacities["max"]:
        yield f"all opacities equal {r.opacities['min']:.3g}"
    elif many and r.opacities["min"] >= 0.5 and r.opacities["max"] <= 0.7311:
        yield "all opacities lie in [0.5, 0.731], the sigmoid of [0, 1]: they look activated twice"
    elif r.opaque_share < 0.02:
        yield f"only {r.opaque_share:.1%} of the Gaussians have an opacity of at least 0.5: the scene is faint"
    if many and longest > 0.0 and r.scales["p50"] > 0.2 * longest:
        yield (
            f"the median Gaussian is {r.scales['p50'] / longest:.2g} scene sizes wide: the scales do not look activated"
            " once, or are in other units than the centers"
        )
    elif many and r.scales["min"] == r.scales["max"]:
        yield f"all largest scales equal {r.scales['min']:.3g}: a point cloud rather than a trained scene?"
    if many and float(g.sh0.min()) >= 0.0 and float(g.sh0.max()) <= 1.0:
        yield "all sh0 lie in [0, 1]: they look like colors, not SH coefficients; the picture will be pale gray"
    if g.sh_degree and not g.shN.any():
        yield f"the SH degree is {g.sh_degree}, but all its coefficients are zero"


def _some(count: int, many: str = "lie", one: str = "lies") -> str:
    return f"1 Gaussian {one}" if count == 1 else f"{count:,} Gaussians {many}"


def axis_vector(axis: str) -> F64:
    """Return the (3,) unit vector of an axis such as "+z" or "-y".

    Raises:
        ValueError: If it is not the name of an axis.
    """
    if axis not in AXES:
        raise ValueError(f"axis: expected one of {', '.join(map(repr, AXES))}, got {axis!r}")
    vector = np.zeros(3)
    vector["xyz".index(axis[1])] = 1.0 if axis[0] == "+" else -1.0
    return vector


def guess_up(g: Gaussians) -> tuple[str, float]:
    """Guess the up axis of a scene.

    Sums log odds for each signed axis from properties that trained scenes share. Captured surroundings are flat: the
    shortest side of the robust box is up. A lone object, recognized by a box without floaters, is tall: its longest
    side is up. Thin Gaussians lie on floors and tables. Mass sits low. Objects stand on the plane through the origin. A
    mild prior favors -y where there is no evidence.

    Args:
        g: The scene.

    Returns:
        The axis, such as "+z" or "-y", and a confidence in (0, 1]: its share of the odds of the six axes.
    """
    odds = dict(_PRIOR)
    robust = g.bounds(0.98) if len(g) else np.zeros((2, 3))
    inside = np.all((g.means >= robust[0]) & (g.means <= robust[1]), axis=1) & (g.opacities >= MIN_ALPHA)
    if np.count_nonzero(inside) >= 8 and np.all(robust[1] > robust[0]):
        kept = g[inside]
        signed = _low_mass(kept, robust)
        unsigned = _flat_normals(kept) + _proportions(g)
        standing = _on_origin_plane(g, robust)
        for axis in AXES:
            which, sign = "xyz".index(axis[1]), (1.0 if axis[0] == "+" else -1.0)
            odds[axis] += float(unsigned[which] + sign * (signed[which] + standing[which]))
    weights = np.exp(np.array([2.0 * odds[axis] for axis in AXES]))
    best = int(weights.argmax())
    return AXES[best], float(weights[best] / weights.sum())


def _areas(g: Gaussians, cap: float) -> F64:
    """Return (N,) opacity times the product of the two larger scales, which are clipped at `cap`."""
    scales = np.minimum(np.sort(g.scales.astype(np.float64), axis=1), cap)
    return np.asarray(g.opacities * scales[:, 1] * scales[:, 2], np.float64)


def _low_mass(kept: Gaussians, robust: F64) -> F64:
    """Return (3,) how much opaque area lies at the low end of each axis, in [-2, 2]; negative for the high end."""
    extent = robust[1] - robust[0]
    weights = _areas(kept, 0.05 * float(extent.max()))
    weights /= weights.sum()
    result = np.zeros(3)
    for axis in range(3):
        x = (kept.means[:, axis].astype(np.float64) - robust[0, axis]) / extent[axis]
        order = np.argsort(x, kind="stable")
        low, middle, high = x[order][np.searchsorted(np.cumsum(weights[order]), [0.05, 0.5, 0.95]).clip(0, len(x) - 1)]
        skew = (high + low - 2.0 * middle) / max(high - low, 1e-12)
        result[axis] = skew + 2.0 * (0.5 - float(weights @ x))
    return result


def _flat_normals(kept: Gaussians) -> F64:
    """Return (3,) half the log of the area with its normal within 20 degrees of each axis over the mean; >= 0."""
    scales = np.sort(kept.scales.astype(np.float64), axis=1)
    areas = _areas(kept, float(np.quantile(scales[:, 2], 0.99))) * (1.0 - scales[:, 0] / scales[:, 1]) ** 2
    normals = np.take_along_axis(kept.rotations(), kept.scales.argmin(axis=1)[:, None, None], axis=2)[:, :, 0]
    aligned = areas @ (np.abs(normals) > _ALIGNED)
    if not aligned.sum() > 0.0:
        return np.zeros(3)
    return np.asarray(0.5 * np.log(np.maximum(aligned / aligned.mean(), 1.0)))


def has_no_floaters(g: Gaussians) -> bool:
    """Return whether the exact box is at most 1.5 times the robust one on every axis: a lone object or a crop."""
    exact, robust = np.subtract(*g.bounds(1.0)[::-1]), np.subtract(*g.bounds(0.98)[::-1])
    return bool(np.all(exact <= 1.5 * robust))


def _proportions(g: Gaussians) -> F64:
    """Return (3,) log odds from the shape of the box: surroundings are flat, a lone object is tall."""
    middle = np.subtract(*g.bounds(0.9)[::-1])
    odds = np.zeros(3)
    order = np.argsort(middle)
    if has_no_floaters(g):
        odds[order[2]] = np.log(middle[order[2]] / max(middle[order[1]], 1e-12))
    else:
        odds[order[0]] = np.log(middle[order[1]] / max(middle[order[0]], 1e-12))
    return np.minimum(odds, 1.5)


def _on_origin_plane(g: Gaussians, robust: F64) -> F64:
    """Return (3,) +1 if the low end of a clean scene lies on the origin's plane on that axis, -1 if the high end."""
    exact = g.bounds(1.0)
    extent = robust[1] - robust[0]
    at = -robust[0] / extent
    result = np.zeros(3)
    for axis in range(3):
        others = np.delete(at, axis)
        clean = exact[1, axis] - exact[0, axis] <= 1.5 * extent[axis]
        if clean and np.all(np.abs(others - 0.5) < 0.25):
            result[axis] = float(abs(at[axis]) < 0.05) - float(abs(at[axis] - 1.0) < 0.05)
    return result
