"""Hidden point removal: what an eye sees of points and Gaussians, without rays."""

from gsvis.hpr.operator import hidden_point_removal

__all__ = ["hidden_point_removal"]
