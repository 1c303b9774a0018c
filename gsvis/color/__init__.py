"""Color that can be sent in pieces: color spaces, spherical harmonics, and spherical radial basis functions (SRBF)."""

from typing import TYPE_CHECKING, Any

from gsvis.color.activation import Activation, active, active_in_box, contributions
from gsvis.color.dictionary import Dictionary, srbf_dictionary
from gsvis.color.epsilon import (
    DEFAULT_EPSILON,
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
from gsvis.color.fit import FitConfig, SrbfFit, fit_srbf
from gsvis.color.omp import SparseCodes, orthogonal_matching_pursuit
from gsvis.color.records import (
    PRECISIONS,
    Grids,
    Precision,
    QuantizedColors,
    bytes_per_base,
    bytes_per_term,
    quantize,
    record_bytes,
    sh_bytes,
)
from gsvis.color.sh import sh_colors, sh_colors_along, towards_gaussian
from gsvis.color.spaces import hsl_to_rgb, rgb_to_hsl
from gsvis.color.srbf import SrbfColors, spherical_coordinates, srbf, unit_vectors
from gsvis.color.storage import SrbfInfo, load_srbf, save_srbf, srbf_info
from gsvis.color.to_sh import FittedSh, to_sh
from gsvis.color.variants import DEFAULT_VARIANT, VARIANTS, Variant, variant

if TYPE_CHECKING:
    from gsvis.color.evaluate_torch import SrbfTensors

__all__ = [
    "DEFAULT_EPSILON",
    "DEFAULT_VARIANT",
    "FLIP_JND",
    "PRECISIONS",
    "VARIANTS",
    "Activation",
    "Dictionary",
    "EpsilonCalibration",
    "Evaluator",
    "FitConfig",
    "FittedSh",
    "Grids",
    "MetricObserver",
    "Observer",
    "Precision",
    "QuantizedColors",
    "SparseCodes",
    "SrbfColors",
    "SrbfFit",
    "SrbfInfo",
    "SrbfTensors",
    "Staircase",
    "StaircaseRule",
    "Variant",
    "active",
    "active_in_box",
    "bytes_per_base",
    "bytes_per_term",
    "calibrate_epsilon",
    "contributions",
    "evaluate",
    "evaluate_along",
    "fit_srbf",
    "hsl_to_rgb",
    "load_srbf",
    "orthogonal_matching_pursuit",
    "quantize",
    "record_bytes",
    "replay",
    "rgb_to_hsl",
    "save_srbf",
    "sh_bytes",
    "sh_colors",
    "sh_colors_along",
    "spherical_coordinates",
    "srbf",
    "srbf_dictionary",
    "srbf_info",
    "to_sh",
    "towards_gaussian",
    "unit_vectors",
    "variant",
]


def __getattr__(name: str) -> Any:
    """Import `SrbfTensors` on first use, because it imports torch."""
    if name == "SrbfTensors":
        from gsvis.color.evaluate_torch import SrbfTensors

        return SrbfTensors
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
