"""Ray casting: proxies, tracers, contributions, visibility, direction sets, and the analysis of a scene.

Names are imported on first use.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from gsvis.raycast.analysis import (
        FACE_LIMITS,
        PAPER,
        Agreement,
        Analysis,
        AnalysisConfig,
        DirectionCdf,
        Settling,
        analyze,
    )
    from gsvis.raycast.picture import ray_image
    from gsvis.raycast.proxies import MIN_ALPHA, EllipsoidProxies
    from gsvis.raycast.second_tracer import CrossCheck, compare, cross_check, describe_check
    from gsvis.raycast.tracer import TAU, Contributions, FirstHits, Tracer
    from gsvis.raycast.visible import GaussianRays, visible_from, visible_in

__all__ = [
    "FACE_LIMITS",
    "MIN_ALPHA",
    "PAPER",
    "TAU",
    "Agreement",
    "Analysis",
    "AnalysisConfig",
    "Contributions",
    "CrossCheck",
    "DirectionCdf",
    "EllipsoidProxies",
    "FirstHits",
    "GaussianRays",
    "Settling",
    "Tracer",
    "analyze",
    "compare",
    "cross_check",
    "describe_check",
    "ray_image",
    "visible_from",
    "visible_in",
]

_HOMES = {
    "analysis": (
        "FACE_LIMITS",
        "PAPER",
        "Agreement",
        "Analysis",
        "AnalysisConfig",
        "DirectionCdf",
        "Settling",
        "analyze",
    ),
    "picture": ("ray_image",),
    "proxies": (
        "MIN_ALPHA",
        "EllipsoidProxies",
    ),
    "second_tracer": (
        "CrossCheck",
        "compare",
        "cross_check",
        "describe_check",
    ),
    "tracer": (
        "TAU",
        "Contributions",
        "FirstHits",
        "Tracer",
    ),
    "visible": (
        "GaussianRays",
        "visible_from",
        "visible_in",
    ),
}


def __getattr__(name: str) -> Any:
    for home, names in _HOMES.items():
        if name in names:
            value = globals()[name] = getattr(import_module(f"{__name__}.{home}"), name)
            return value
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
