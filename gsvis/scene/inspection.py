"""Inspect a scene: counts, bounds, the likely up axis, quantiles, problems.

Frame and units are the scene's own. All figures are estimates from the Gaussians alone. This module knows no file and
no renderer. It is deterministic: the same scene gives the same report.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis import _check
from gsvis.scene.axes import axis_vector, describe_direction
from gsvis.scene.core import find_ball
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.repeats import first_equal
from gsvis.scene.upright import SURE, Upright, doubt_up, find_up

__all__ = ["SceneReport", "inspect_scene"]

F64 = NDArray[np.float64]

MIN_ALPHA = 1.0 / 255.0  # docs/conventions.md
FLOATER_EXTENT = 5.0  # in sizes of what holds 98% of the centers, about its middle
_QUANTILES = {"min": 0.0, "p1": 0.01, "p10": 0.1, "p50": 0.5, "p90": 0.9, "p99": 0.99, "max": 1.0}


@dataclass(frozen=True)
class SceneReport:
    """Results of `inspect_scene`. Lengths are in scene units, shares are of all Gaussians, in [0, 1].

    Args:
        count: Number of Gaussians.
        sh_degree: 0 to 3.
        bytes_in_memory: Bytes of the arrays.
        bounds: Lowest and highest corner of the box of all centers; empty for an empty scene.
        robust_bounds: The same for the middle 98% of the centers on each axis.
        up: Likely up axis in words, such as "+z", or a vector and its angle to the nearest axis.
        up_vector: The same as a unit vector.
        up_confidence: In (0, 1]; 1 if it is stated or given.
        opacities: Quantiles of the opacities by name.
        scales: Quantiles of the largest standard deviation of each Gaussian by name.
        invisible_share: Share with an opacity below 1/255.
        opaque_share: Share with an opacity of at least one half.
        floaters: Number of centers outside 5 times the ball that holds 98% of the centers.
        farthest: Distance of the farthest center from the middle of this ball, in diameters of it.
        duplicates: Number of Gaussians with the same place, shape and opacity as an earlier one.
        needle_share: Share with a largest scale more than 10 times the middle one.
        disc_share: Share, without needles, with a smallest scale less than a tenth of the middle one.
        giant_share: Share with a largest scale more than a tenth of the diameter of this ball.
        problems: Likely problems, one sentence each; empty if there are none.
    """

    count: int
    sh_degree: int
    bytes_in_memory: int
    bounds: list[list[float]]
    robust_bounds: list[list[float]]
    up: str
    up_vector: list[float]
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


def inspect_scene(g: Gaussians, *, up: ArrayLike | str | None = None) -> SceneReport:
    """Count, measure and check a scene.

    Args:
        g: The scene; may be empty.
        up: The up axis if known, such as "+z" or (0, 0, 1); None takes that of the scene's facts, else guesses.

    Returns:
        The report; `problems` lists what to check first.
    """
    found = find_up(g) if up is None else _given_up(g, up)
    name = describe_direction(found.up)
    vector = found.up.tolist()
    if len(g) == 0:
        zeros = dict.fromkeys(_QUANTILES, 0.0)
        return SceneReport(
            count=0,
            sh_degree=g.sh_degree,
            bytes_in_memory=0,
            bounds=[],
            robust_bounds=[],
            up=name,
            up_vector=vector,
            up_confidence=found.confidence,
            opacities=zeros,
            scales=zeros,
            invisible_share=0.0,
            opaque_share=0.0,
            floaters=0,
            farthest=0.0,
            duplicates=0,
            needle_share=0.0,
            disc_share=0.0,
            giant_share=0.0,
            problems=["the scene has no Gaussians"],
        )
    robust = g.bounds(0.98)
    middle, radius = find_ball(g)  # unlike a box, independent of the scene's rotation
    away = np.linalg.norm(g.means.astype(np.float64) - middle, axis=1)
    least, mid, most = np.sort(g.scales, axis=1).T
    needle = most > 10.0 * mid
    report = SceneReport(
        count=len(g),
        sh_degree=g.sh_degree,
        bytes_in_memory=g.nbytes,
        bounds=g.bounds(1.0).tolist(),
        robust_bounds=robust.tolist(),
        up=name,
        up_vector=vector,
        up_confidence=found.confidence,
        opacities=_quantiles(g.opacities),
        scales=_quantiles(most),
        invisible_share=float(np.mean(g.opacities < MIN_ALPHA)),
        opaque_share=float(np.mean(g.opacities >= 0.5)),
        floaters=int(np.count_nonzero(away > FLOATER_EXTENT * radius)) if radius > 0.0 else 0,
        farthest=float(away.max()) / (2.0 * radius) if radius > 0.0 else 0.0,
        duplicates=_count_duplicates(g),
        needle_share=float(np.mean(needle)),
        disc_share=float(np.mean(~needle & (least < 0.1 * mid))),
        giant_share=float(np.mean(most > 0.2 * radius)) if radius > 0.0 else 0.0,
        problems=[],
    )
    doubts = [found.doubt] if found.doubt else []
    return replace(report, problems=[*doubts, *_problems(report, g)])


def _given_up(g: Gaussians, up: ArrayLike | str) -> Upright:
    """Return a given up axis, with evidence against it."""
    vector = axis_vector(up) if isinstance(up, str) else np.asarray(up, np.float64)
    unit = np.asarray(_check.unit_vectors("up", vector.reshape(1, -1))[0], np.float64)
    return Upright(unit, 1.0, "given", doubt_up(g, unit))


def _quantiles(values: NDArray[np.float32]) -> dict[str, float]:
    """Return quantiles by name."""
    found = np.quantile(values.astype(np.float64), list(_QUANTILES.values()))
    return dict(zip(_QUANTILES, found.tolist(), strict=True))


def _count_duplicates(g: Gaussians) -> int:
    """Count the Gaussians that repeat an earlier one bit for bit in place, shape and opacity."""
    return int(np.count_nonzero(first_equal(g) != np.arange(len(g))))


def _problems(r: SceneReport, g: Gaussians) -> Iterator[str]:
    """Yield likely problems, the most important first."""
    low, high = np.array(r.robust_bounds)
    longest = float((high - low).max())
    if r.floaters:
        yield (
            f"{_count_with_verb(r.floaters)} outside {FLOATER_EXTENT:g} times the scene, the farthest {r.farthest:,.0f}"
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
        yield f"{_count_with_verb(r.duplicates, 'repeat', 'repeats')} an earlier one exactly"
    if longest == 0.0:
        yield "all robust centers coincide"
    elif longest > 1000.0 or longest < 0.1:
        unit = "meters are unlikely; millimeters or map units?" if longest > 1000.0 else "meters are unlikely"
        yield f"the scene is {longest:.3g} units long: {unit}"
    if r.up_confidence < SURE:
        yield f"the up axis is uncertain ({r.up}, with a confidence of {r.up_confidence:.0%}); verify it"


def _value_problems(r: SceneReport, g: Gaussians, longest: float) -> Iterator[str]:
    """Yield problems of values, such as a wrong activation on import."""
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


def _count_with_verb(count: int, many: str = "lie", one: str = "lies") -> str:
    """Return a number of Gaussians with a verb in singular or plural."""
    return f"1 Gaussian {one}" if count == 1 else f"{count:,} Gaussians {many}"
