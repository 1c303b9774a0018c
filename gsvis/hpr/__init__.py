"""Hidden point removal: what an eye sees of points and Gaussians, without rays."""

from gsvis.hpr.calibration import Calibration, Trial, calibrate_radius
from gsvis.hpr.gaussians import OcclusionHull, visible_gaussians
from gsvis.hpr.operator import hidden_point_removal

__all__ = [
    "Calibration",
    "OcclusionHull",
    "Trial",
    "calibrate_radius",
    "hidden_point_removal",
    "visible_gaussians",
]
