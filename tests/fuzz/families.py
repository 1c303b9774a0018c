"""All targets by name."""

from __future__ import annotations

from dataclasses import replace

from tests.fuzz import (
    cameras,
    damage,
    damage_stores,
    damage_wire,
    edits,
    packages,
    scenes,
    stores,
    training,
    unfinished,
    wire,
)
from tests.fuzz.targets import Target

__all__ = ["TARGETS"]

_DAMAGE = damage.DAMAGE | damage_stores.DAMAGE | damage_wire.DAMAGE

TARGETS: dict[str, Target] = {
    target.name: replace(target, damage=_DAMAGE.get(target.name, target.damage))
    for family in (scenes, cameras, edits, stores, training, unfinished, wire, packages)
    for target in family.TARGETS
}
