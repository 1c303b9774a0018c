"""Adaptive streaming: which records a client gets next, from its pose, its bandwidth and what it holds already.

    store = CandidateStore(index)                                   # one for a scene
    scheduler = Scheduler(store, FieldOfView.of_degrees(90, 70, margin=8))    # one for a client
    scheduler.on_pose(t, position, quat)
    batch = scheduler.next_batch(t, scheduler.allowance())
    scheduler.on_sent(t, nbytes)                                    # of the message that the batch has become
    scheduler.on_ack(t, nbytes, seconds)

Pure functions and small state machines: no socket, no clock (time is an argument), no torch. The same objects drive the
simulator and the server. Names are imported when first used.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from gsvis.abr.candidates import CandidateStore
    from gsvis.abr.cells import StoreCells, class_weights
    from gsvis.abr.classes import Classes, FieldOfView, classify
    from gsvis.abr.estimate import Ewma, HarmonicMean, RobustMpc, ThroughputEstimator, estimator
    from gsvis.abr.holdings import Holdings
    from gsvis.abr.index import CellMembers, CellSets, SceneIndex
    from gsvis.abr.planner import Batch, Planner
    from gsvis.abr.policies import POLICIES, UtilityConfig
    from gsvis.abr.predict import KalmanPose, LastPose, LinearPose, Pose, PosePredictor, predictor
    from gsvis.abr.qoe import Difference, Qoe, QoeConfig, paired_difference, quality_of_experience
    from gsvis.abr.scheduler import Scheduler, SchedulerConfig
    from gsvis.abr.traces import BandwidthTrace, load_trace

__all__ = [
    "POLICIES",
    "BandwidthTrace",
    "Batch",
    "CandidateStore",
    "CellMembers",
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
    "Scheduler",
    "SchedulerConfig",
    "StoreCells",
    "ThroughputEstimator",
    "UtilityConfig",
    "class_weights",
    "classify",
    "estimator",
    "load_trace",
    "paired_difference",
    "predictor",
    "quality_of_experience",
]

_HOMES = {
    "candidates": ("CandidateStore",),
    "cells": ("StoreCells", "class_weights"),
    "classes": ("Classes", "FieldOfView", "classify"),
    "estimate": ("Ewma", "HarmonicMean", "RobustMpc", "ThroughputEstimator", "estimator"),
    "holdings": ("Holdings",),
    "index": ("CellMembers", "CellSets", "SceneIndex"),
    "planner": ("Batch", "Planner"),
    "policies": ("POLICIES", "UtilityConfig"),
    "predict": ("KalmanPose", "LastPose", "LinearPose", "Pose", "PosePredictor", "predictor"),
    "qoe": ("Difference", "Qoe", "QoeConfig", "paired_difference", "quality_of_experience"),
    "scheduler": ("Scheduler", "SchedulerConfig"),
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
