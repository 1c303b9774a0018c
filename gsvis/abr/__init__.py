"""Choose the records that a client gets next, from its pose, its bandwidth and what it holds already.

    candidates = CandidateIndex(index)                                      # one for a scene
    planner = Planner(candidates, FieldOfView.from_degrees(90, 70, margin=8))   # one for a client
    planner.on_pose(t, position, quat)
    batch = planner.next_batch(t, budget, rate)

Pure functions and small state machines: no socket, no clock (time is an argument), no torch. `gsvis.stream.Session`
measures the link and turns batches into messages. Names are imported on first use.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from gsvis.abr.batches import Batch
    from gsvis.abr.candidates import CandidateIndex
    from gsvis.abr.classes import Classes, FieldOfView, classify
    from gsvis.abr.config import AbrConfig
    from gsvis.abr.estimate import Ewma, HarmonicMean, RobustMpc, ThroughputEstimator, estimator
    from gsvis.abr.holdings import Holdings
    from gsvis.abr.index import ActiveSets, CellSets, SceneIndex, SceneTerms
    from gsvis.abr.planner import Planner
    from gsvis.abr.policies import POLICIES, UtilityConfig
    from gsvis.abr.predict import KalmanPose, LastPose, LinearPose, Pose, PosePredictor, predictor
    from gsvis.abr.qoe import Difference, Qoe, QoeConfig, paired_difference, quality_of_experience
    from gsvis.abr.traces import BandwidthTrace, load_trace

__all__ = [
    "POLICIES",
    "AbrConfig",
    "ActiveSets",
    "BandwidthTrace",
    "Batch",
    "CandidateIndex",
    "CellSets",
    "Classes",
    "Difference",
    "Ewma",
    "FieldOfView",
    "HarmonicMean",
    "Holdings",
    "KalmanPose",
    "LastPose",
    "LinearPose",
    "Planner",
    "Pose",
    "PosePredictor",
    "Qoe",
    "QoeConfig",
    "RobustMpc",
    "SceneIndex",
    "SceneTerms",
    "ThroughputEstimator",
    "UtilityConfig",
    "classify",
    "estimator",
    "load_trace",
    "paired_difference",
    "predictor",
    "quality_of_experience",
]

_HOMES = {
    "batches": ("Batch",),
    "candidates": ("CandidateIndex",),
    "classes": ("Classes", "FieldOfView", "classify"),
    "config": ("AbrConfig",),
    "estimate": ("Ewma", "HarmonicMean", "RobustMpc", "ThroughputEstimator", "estimator"),
    "holdings": ("Holdings",),
    "index": ("ActiveSets", "CellSets", "SceneIndex", "SceneTerms"),
    "planner": ("Planner",),
    "policies": ("POLICIES", "UtilityConfig"),
    "predict": ("KalmanPose", "LastPose", "LinearPose", "Pose", "PosePredictor", "predictor"),
    "qoe": ("Difference", "Qoe", "QoeConfig", "paired_difference", "quality_of_experience"),
    "traces": ("BandwidthTrace", "load_trace"),
}


def __getattr__(name: str) -> Any:
    for home, names in _HOMES.items():
        if name in names:
            value = globals()[name] = getattr(import_module(f"{__name__}.{home}"), name)
            return value
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
