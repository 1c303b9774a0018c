"""Colour that can be sent in pieces: spaces, spherical harmonics, and functions on the sphere in their place."""

from gsvis.color.activation import Activation, active, active_in_box, contributions
from gsvis.color.epsilon import (
    FLIP_JND,
    EpsilonCalibration,
    MetricObserver,
    Observer,
    Staircase,
    StaircaseRule,
    calibrate_epsilon,
    replay,
)
from gsvis.color.evaluate import Evaluator, evaluate, evaluate_along
from gsvis.color.sh import sh_colors, sh_colors_along, towards_gaussian
from gsvis.color.spaces import (
    hsl_to_rgb,
    hsv_to_rgb,
    hue_vector,
    rgb_by_hsl_lightness,
    rgb_by_hsl_saturation,
    rgb_by_hsv_saturation,
    rgb_by_hsv_value,
    rgb_by_yuv_luma,
    rgb_to_hsl,
    rgb_to_hsv,
    rgb_to_yuv,
    yuv_to_rgb,
)

__all__ = [
    "FLIP_JND",
    "Activation",
    "EpsilonCalibration",
    "Evaluator",
    "MetricObserver",
    "Observer",
    "Staircase",
    "StaircaseRule",
    "active",
    "active_in_box",
    "calibrate_epsilon",
    "contributions",
    "evaluate",
    "evaluate_along",
    "hsl_to_rgb",
    "hsv_to_rgb",
    "hue_vector",
    "replay",
    "rgb_by_hsl_lightness",
    "rgb_by_hsl_saturation",
    "rgb_by_hsv_saturation",
    "rgb_by_hsv_value",
    "rgb_by_yuv_luma",
    "rgb_to_hsl",
    "rgb_to_hsv",
    "rgb_to_yuv",
    "sh_colors",
    "sh_colors_along",
    "towards_gaussian",
    "yuv_to_rgb",
]
