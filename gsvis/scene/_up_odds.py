"""Weigh the evidence for each direction that could be up, and return the likely one with its confidence.

Two hypotheses compete. Either the scene has ground or floors: level slabs on which things stand. Or it is an object:
tall, with upright surface around it and a wide base. Weights are log odds, fitted to scenes with known up axes, as they
are and rotated at random; benchmarks/upright.py measures them on other scenes.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gsvis.scene._up_candidates import find_candidates, find_plumb, settle
from gsvis.scene._up_evidence import AxisEvidence, measure_axis
from gsvis.scene._up_sample import Sample
from gsvis.scene.axes import AXES, axis_vector

__all__ = ["Likely", "find_likely"]

F64 = NDArray[np.float64]

_LIFT = 0.65  # power of the geometry's confidence up to which conventions of files can lift it
_SAME = 15.0  # degrees within which candidates are one answer
_LEAST_CONTACT = 0.01
_SHEET = 0.6  # most confidence in a sheet on which nothing stands, or which may as well be a wall
_TEMPER = 0.7  # of the odds of axes: the figures behind them are not independent
_THIN = (0.06, 0.14)  # height over width of a sheet, and of what is surely none
_FULL = (0.08, 0.18)  # opacity on a slab that is bare, and on one with much on it
_OBJECT = 0.7  # most confidence in an object by its shape alone: some lie down
_ONE_WAY = (0.15, 0.35)  # share of the upright surface off its main way: below, ground and wall can be exchanged
_SNAP = 6.0  # degrees within which an object stands along an axis of its file
# Log odds of directions by convention: COLMAP gives -y, tilted by up to 40 degrees; viewers +y; scanners and CAD +z.
_ON_AXIS = {"-y": 1.6, "+y": 1.0, "+z": 1.2}
_TILTED = 0.7
_TILT = 40.0  # degrees


class Likely(NamedTuple):
    """The likely up axis of a sample.

    Attributes:
        up: (3,) unit vector.
        confidence: In (0, 1], that the direction is right within about ten degrees.
        geometry: Confidence without any convention of file formats.
        ground: Whether it was found by ground or floors, not by the shape of an object.
        evidence: Evidence along `up`.
        other: (3,) the next likely direction, more than 15 degrees away; None if there was only one candidate.
    """

    up: F64
    confidence: float
    geometry: float
    ground: bool
    evidence: AxisEvidence
    other: F64 | None = None


def find_likely(sample: Sample) -> Likely:
    """Return the likely up axis.

    Conventions of file formats can raise the confidence only to a power of the confidence from the Gaussians alone.

    Args:
        sample: The surface of the core.
    """
    axes, odds = _best_apart(sample, find_candidates(sample))
    directions = np.concatenate([axes, -axes])
    total = _signed_odds(odds)
    shares = _softmax(total)
    informed = _softmax(total + np.array([_convention(each) for each in directions]))
    best = int(informed.argmax())
    same = directions @ directions[best] > np.cos(np.radians(_SAME))
    geometry = float(shares[same].sum())
    confidence = min(float(informed[same].sum()), geometry**_LIFT)
    which = best % len(axes)
    way = best // len(axes)
    ground = bool(odds[which, way, 0] >= odds[which, way, 1])
    up = settle(sample, directions[best])
    evidence = measure_axis(sample, up)
    most = _most_confidence(evidence) if ground else _OBJECT
    geometry = min(geometry, most)
    confidence = min(confidence, most if ground else geometry**_LIFT)
    up = find_plumb(sample, up) if ground else _snap(up)
    other = None if same.all() else _snap(settle(sample, directions[int(np.where(same, 0.0, informed).argmax())]))
    return Likely(up, confidence, geometry, ground, evidence, other)


def _best_apart(sample: Sample, axes: F64) -> tuple[F64, F64]:
    """Return the best of candidates that are near each other, and their odds (K, 2 signs, 2 hypotheses)."""
    odds = np.array([_weigh(measure_axis(sample, axis)) for axis in axes])
    kept: list[int] = []
    for k in np.argsort(-odds.max(axis=(1, 2)), kind="stable"):
        if all(abs(axes[k] @ axes[other]) < np.cos(np.radians(_SAME)) for other in kept):
            kept.append(int(k))
    return axes[kept], odds[kept]


def _signed_odds(odds: F64) -> F64:
    """Return (2K,) log odds of all directions: K axes, then their opposites."""
    each = np.logaddexp(odds[:, :, 0], odds[:, :, 1])
    both = np.logaddexp(each[:, 0], each[:, 1])
    return np.asarray((each + (_TEMPER - 1.0) * both[:, None]).T.ravel())


def _most_confidence(e: AxisEvidence) -> float:
    """Return the largest confidence in ground or floors: less for sheets, and for possible walls."""
    if e.contact < _LEAST_CONTACT:
        return _SHEET
    thick = max(_between(e.height, _THIN), _between(e.contact, _FULL))
    return _SHEET + (1.0 - _SHEET) * min(thick, _between(e.other, _ONE_WAY))


def _between(value: float, ends: tuple[float, float]) -> float:
    """Return where a value lies between two ends, from 0 to 1."""
    return float(np.clip((value - ends[0]) / (ends[1] - ends[0]), 0.0, 1.0))


def _weigh(e: AxisEvidence) -> F64:
    """Return (2, 2) log odds: of the axis and its opposite, as ground and as object."""
    ring = np.log(max(e.upright * e.around, 0.01) / 0.15)
    wide = np.clip(-np.log(max(e.height, 1e-3)), -1.5, 1.5)
    ground = (
        1.5 * np.log(max(e.level, 0.04) / 0.08)
        + np.log((e.slab + 0.02) / 0.05)
        + 0.75 * max(ring, -2.0)
        + 3.0 * max(e.flat - 0.25, 0.0)
        + 0.8 * wide
        + 0.8 * abs(e.low)
    )
    upward = 0.65 * (e.sided + 1.5 * e.low + e.clutter + 1.2 * e.bright)
    thing = 0.6 + 2.0 * ring - 0.8 * wide
    standing = 0.65 * (e.base + e.low)
    return np.array([[ground + upward, thing + standing], [ground - upward, thing - standing]])


def _convention(direction: F64) -> float:
    """Return the log odds of a direction by the conventions of file formats."""
    angles = {name: np.degrees(np.arccos(np.clip(axis_vector(name) @ direction, -1.0, 1.0))) for name in AXES}
    near = max(odds * float(np.exp(-0.5 * (angles[name] / 2.0) ** 2)) for name, odds in _ON_AXIS.items())
    tilted = _TILTED * float(np.clip(2.0 - angles["-y"] / _TILT, 0.0, 1.0))
    return float(max(near, tilted))


def _snap(up: F64) -> F64:
    """Return the axis of the file within a few degrees of a direction, or the direction itself."""
    axes = np.array([axis_vector(name) for name in AXES])
    nearest = axes[int((axes @ up).argmax())]
    return nearest if nearest @ up > np.cos(np.radians(_SNAP)) else up


def _softmax(odds: F64) -> F64:
    """Return odds as shares that sum to 1."""
    weights = np.exp(odds - odds.max())
    return np.asarray(weights / weights.sum())
