"""Hidden point removal and a hierarchical z-buffer: find what an eye sees of points and Gaussians without rays."""

from gsvis.hpr.gaussians import OcclusionHull, visible_gaussians
from gsvis.hpr.hybrid import hybrid
from gsvis.hpr.operator import hidden_point_removal
from gsvis.hpr.zbuffer import Search, Seen, Splats, ZBuffer, look_around, squares_around

__all__ = [
    "OcclusionHull",
    "Search",
    "Seen",
    "Splats",
    "ZBuffer",
    "hidden_point_removal",
    "hybrid",
    "look_around",
    "squares_around",
    "visible_gaussians",
]


def __dir__() -> list[str]:
    return sorted(__all__)
