"""Scaffold-GS: anchors with features, from which small networks make the Gaussians of a view.

Each anchor carries a feature, offsets of a few Gaussians, and scales. Three networks take the feature and the direction
of the camera, and return opacities, colors and shapes; Gaussians without opacity are not drawn. Sent are
the networks, then anchors in Morton order, in half floats; what has arrived is shown.

References:
    Lu et al., "Scaffold-GS: Structured 3D Gaussians for View-Adaptive Rendering", CVPR 2024.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from arena.anchors import Anchors, find_places, levels_of
from arena.budget import Allowance, Budget, descend
from arena.course import Course
from arena.files import load_arrays, save_arrays
from arena.stages import PARTS, Stages
from arena.systems.system import System, Training
from gsvis.errors import FormatError
from gsvis.progress import Progress
from gsvis.scene.cameras import Cameras

__all__ = ["SYSTEMS", "open_anchors", "train_anchors"]

FILE = "scene.npz"


def train_anchors(course: Course, budget: Budget, levels: int, progress: Progress) -> Anchors:
    """Return anchors at the points of the reconstruction, trained until the budget is spent.

    Args:
        course: What to train on.
        budget: What to spend; its most Gaussians bound the anchors.
        levels: Levels of an octree; 1 for Scaffold-GS.
        progress: Called with stage "train".
    """
    most = budget.allowance.gaussians // Anchors.PER
    anchors = Anchors.from_places(find_places(course.points, most, levels), levels_of(course, levels))
    rates = anchors.rates()
    descend(course, budget, anchors.draw, rates, rates_end=0.02, progress=progress)
    return anchors


def save_anchors(anchors: Anchors, path: Path) -> None:
    """Write anchors and networks in half floats, anchors by level and Morton order."""
    save_arrays(path, **anchors.arrays())


def open_anchors(course: Course, folder: Path) -> Stages:
    """Return the stages of a file: the networks, then anchors in the order of the file.

    Raises:
        FormatError: If the file is damaged.
    """
    path = folder / FILE
    try:
        anchors = Anchors.from_arrays(load_arrays(path))
    except (KeyError, ValueError, RuntimeError) as error:
        raise FormatError(path, "", "anchors and networks", str(error), f"delete {folder} to train again") from None
    nbytes = path.stat().st_size
    header = anchors.network_bytes
    row = (nbytes - header) / len(anchors)
    counts = np.unique(np.linspace(0, len(anchors), PARTS + 1).astype(np.int64))[1:]
    ends = tuple(int(np.ceil(header + row * count)) for count in counts)

    def draw(stage: int, camera: Cameras) -> NDArray[np.float32]:
        with torch.no_grad():
            image = anchors.first(int(counts[stage])).draw(camera)[0]
        return np.asarray(image.clamp(0.0, 1.0).numpy(), np.float32)

    return Stages(ends, draw, len(anchors) * Anchors.PER)


def _train(course: Course, allowance: Allowance, folder: Path, progress: Progress) -> None:
    save_anchors(train_anchors(course, Budget(allowance), 1, progress), folder / FILE)


SYSTEMS = (
    System(
        "Scaffold-GS",
        Training("scaffold", _train),
        open_anchors,
        "Lu et al., CVPR 2024",
        "anchors stand at the points of the reconstruction and do not grow; 5 Gaussians an anchor, not 10; no bank"
        " of features; half floats where the authors send single ones",
        "32.70 dB (their table, by nerfbaselines); no size found; mean of nine scenes 266 MB (3DGS.zip)",
    ),
)
