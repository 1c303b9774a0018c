"""Ray casting: proxies, tracers, contributions, visibility and direction sets."""

from gsvis.raycast.proxies import MIN_ALPHA, EllipsoidProxies
from gsvis.raycast.tracer import TAU, Contributions, FirstHits, Tracer

__all__ = ["MIN_ALPHA", "TAU", "Contributions", "EllipsoidProxies", "FirstHits", "Tracer"]
