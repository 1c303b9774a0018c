"""All targets by name."""

from __future__ import annotations

from tests.fuzz import cameras, packages, scenes, stores, training, wire
from tests.fuzz.targets import Target

__all__ = ["TARGETS"]

TARGETS: dict[str, Target] = {
    target.name: target for family in (scenes, cameras, stores, training, wire, packages) for target in family.TARGETS
}
