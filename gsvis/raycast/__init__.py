"""Ray casting: proxies, tracers, contributions, visibility and direction sets."""

from gsvis.raycast import directions
from gsvis.raycast.picture import ray_image
from gsvis.raycast.proxies import MIN_ALPHA, EllipsoidProxies
from gsvis.raycast.tracer import TAU, Contributions, FirstHits, Tracer
from gsvis.raycast.visible import GaussianRays, visible_from, visible_in

__all__ = [
    "MIN_ALPHA",
    "TAU",
    "Contributions",
    "EllipsoidProxies",
    "FirstHits",
    "GaussianRays",
    "Tracer",
    "directions",
    "ray_image",
    "visible_from",
    "visible_in",
]


def __dir__() -> list[str]:
    return sorted(__all__)
