"""All targets by name."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

from tests.fuzz import (
    asked,
    cameras,
    damage,
    damage_documents,
    damage_files,
    damage_sealed,
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
from tests.fuzz.targets import Case, Target

__all__ = ["TARGETS"]

_DAMAGE = (damage, damage_documents, damage_files, damage_stores, damage_sealed, damage_wire)


def _damage_of(name: str) -> dict[str, Case]:
    """The cases with one deliberate fault each, of all modules that make some for a target."""
    makers = [module.DAMAGE[name] for module in _DAMAGE if name in module.DAMAGE]
    return {what: case for make in makers for what, case in make().items()}


TARGETS: dict[str, Target] = {
    target.name: replace(target, damage=partial(_damage_of, target.name))
    for family in (scenes, cameras, edits, stores, training, unfinished, asked, wire, packages)
    for target in family.TARGETS
}
