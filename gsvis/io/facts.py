"""Write the facts of a scene as JSON, which each format stores in its own place, and read them back.

Only facts that differ from the default are written, so files of ordinary scenes keep their bytes. Damaged or unknown
facts are ignored and never an error: a damaged note must not make the Gaussians unreadable.
"""

from __future__ import annotations

import json
from dataclasses import fields
from typing import Any

import numpy as np

from gsvis.scene.facts import SceneFacts

__all__ = ["KEY", "facts_from_json", "facts_to_json", "parse_facts", "spell_facts"]

KEY = "gsvis"
"""Key of the facts in JSON formats."""

_MOST_TEXT = 2048
_MOST_SOURCE = 120
_ROUNDING = 1e-3  # tolerance on the length of unit vectors and quaternions
_DEFAULT = SceneFacts()

Triple = tuple[float, float, float]
Quad = tuple[float, float, float, float]


def facts_to_json(facts: SceneFacts) -> dict[str, Any]:
    """Return the facts that differ from the default, ready for JSON; empty if none does."""
    names = [each.name for each in fields(SceneFacts)]
    found = {name: getattr(facts, name) for name in names if getattr(facts, name) != getattr(_DEFAULT, name)}
    if "up_source" in found:
        found["up_source"] = found["up_source"][:_MOST_SOURCE]
    return found


def spell_facts(facts: SceneFacts) -> str:
    """Return the facts as one line of ASCII JSON; empty if all have their defaults."""
    found = facts_to_json(facts)
    return json.dumps(found, separators=(",", ":"), allow_nan=False) if found else ""


def parse_facts(text: str | bytes) -> SceneFacts:
    """Return the facts of a text that `spell_facts` wrote; the default for any other text."""
    if len(text) > _MOST_TEXT:
        return _DEFAULT
    try:
        return facts_from_json(json.loads(text))
    except (ValueError, RecursionError):
        return _DEFAULT


def facts_from_json(value: Any) -> SceneFacts:
    """Return the facts of a JSON object; invalid entries are ignored."""
    if not isinstance(value, dict):
        return _DEFAULT
    axis = _parse_triple(value.get("up"))
    if axis is not None and not abs(float(np.linalg.norm(axis)) - 1.0) < _ROUNDING:
        axis = None
    source = value.get("up_source")
    if axis is None or not isinstance(source, str) or not source.isprintable():
        source = ""
    box, box_turn = _parse_box(value)
    return SceneFacts(
        origin=_parse_triple(value.get("origin")) or _DEFAULT.origin,
        up=axis,
        up_source=source[:_MOST_SOURCE],
        antialiased=value.get("antialiased") is True,
        meters_per_unit=_parse_length(value.get("meters_per_unit")),
        box=box,
        box_turn=box_turn,
        eye=_parse_triple(value.get("eye")),
        clearance=_parse_length(value.get("clearance")),
    )


def _parse_box(value: dict[str, Any]) -> tuple[tuple[Triple, Triple] | None, Quad]:
    """Return the box and its rotation; None and no rotation unless both are valid."""
    none = None, _DEFAULT.box_turn
    box = value.get("box")
    if not isinstance(box, list) or len(box) != 2:
        return none
    low, high = (_parse_triple(corner) for corner in box)
    if low is None or high is None or any(a > b for a, b in zip(low, high, strict=True)):
        return none
    if "box_turn" not in value:
        return (low, high), _DEFAULT.box_turn
    turn = _parse_quaternion(value["box_turn"])
    return none if turn is None else ((low, high), turn)


def _parse_triple(value: Any) -> Triple | None:
    """Return three finite numbers; None for anything else."""
    if not isinstance(value, list) or len(value) != 3:
        return None
    x, y, z = (_parse_number(each) for each in value)
    return None if x is None or y is None or z is None else (x, y, z)


def _parse_quaternion(value: Any) -> Quad | None:
    """Return a unit quaternion, normalized; None for anything else."""
    if not isinstance(value, list) or len(value) != 4:
        return None
    found = [_parse_number(each) for each in value]
    numbers = np.array([np.nan if each is None else each for each in found])
    length = float(np.linalg.norm(numbers))
    if not abs(length - 1.0) < _ROUNDING:
        return None
    w, x, y, z = (numbers / length).tolist()
    return w, x, y, z


def _parse_length(value: Any) -> float | None:
    """Return a finite JSON number above 0; None for anything else."""
    number = _parse_number(value)
    return number if number is not None and number > 0.0 else None


def _parse_number(value: Any) -> float | None:
    """Return a finite JSON number; None for anything else."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    try:
        number = float(value)
    except OverflowError:
        return None
    return number if abs(number) < 1e30 else None
