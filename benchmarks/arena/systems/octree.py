"""Octree-GS: Scaffold-GS with anchors in levels of an octree, the lower ones alone seen from afar.

Sent are the networks, then anchors level by level, in Morton order within one; what has arrived is shown.

References:
    Ren et al., "Octree-GS: Towards Consistent Real-time Rendering with LOD-Structured 3D Gaussians", 2024.
"""

from __future__ import annotations

from pathlib import Path

from arena.budget import Allowance, Budget
from arena.course import Course
from arena.systems.scaffold import FILE, open_anchors, save_anchors, train_anchors
from arena.systems.system import System, Training
from gsvis.progress import Progress

__all__ = ["SYSTEMS"]

LEVELS = 3


def _train(course: Course, allowance: Allowance, folder: Path, progress: Progress) -> None:
    save_anchors(train_anchors(course, Budget(allowance), LEVELS, progress), folder / FILE)


SYSTEMS = (
    System(
        "Octree-GS",
        Training("octree", _train),
        open_anchors,
        "Ren et al., 2024",
        "as Scaffold-GS here, in three levels; anchors do not grow, levels are not trained one after another; the paper"
        " has no order of transmission: lower levels first",
        "none found for bonsai",
    ),
)
