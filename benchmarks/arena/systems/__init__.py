"""The systems of the arena, in the order of the tables. Copies of others state what is simplified."""

from __future__ import annotations

from arena.systems import compact3d, compressed3d, gaussians, layers, octree, ours, scaffold, sogg
from arena.systems.system import System, Training, trained

__all__ = ["SYSTEMS", "System", "Training", "trained"]

SYSTEMS: tuple[System, ...] = (
    *ours.SYSTEMS,
    *gaussians.SYSTEMS,
    *sogg.SYSTEMS,
    *compressed3d.SYSTEMS,
    *scaffold.SYSTEMS,
    *octree.SYSTEMS,
    *compact3d.SYSTEMS,
    *layers.SYSTEMS,
)
"""All systems; the first is ours, and all others are compared with it."""
