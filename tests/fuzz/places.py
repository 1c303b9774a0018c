"""JSON with other values at some of its places, deliberate or random: what a hostile writer changes and seals anew."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from random import Random
from typing import Any

__all__ = ["DROP", "cases_of", "change_json", "edited"]

Case = dict[str, bytes]
JSON_VALUES: tuple[Any, ...] = (
    None, True, False, 0, 1, -1, 2, 3, 4, 255, 256, 1 << 31, 1 << 32, 1 << 63, 1 << 64, 10**30, 10**400, 0.5, 1e300,
    -1e300, 1e308, math.nan, math.inf, -math.inf, "", "x", "..", "/", "../x", ".", "\\", "\0", "meta.json",
    "a" * 5000, "\ud800", "é", [], {}, [[]], [{}], [1], [0, 0], [1, 2, 3], [0.0, 0.0, 0.0], [None], ["a"], [1e300] * 3,
    [1, 2, 3, 4], {"a": 1}, [[1, 2], [3]], 3.0, 2.5, "rgb", "hsl", "0" * 64, "f" * 64,
)  # fmt: skip

DROP = object()
"""In place of a value: the place is left out."""

Places = dict[str, Any]


def edited(document: Any, places: Places) -> Any:
    """A copy with other values at places such as `tiles.0.coords`; a key may be new, and so may the end of a list."""
    found = json.loads(json.dumps(document))
    for trail, value in places.items():
        *above, last = [int(key) if key.isdecimal() else key for key in trail.split(".")]
        holder = found
        for key in above:
            holder = holder[key]
        if value is DROP:
            del holder[last]
        elif isinstance(holder, list) and last == len(holder):
            holder.append(value)
        else:
            holder[last] = value
    return found


def cases_of(document: Any, faults: dict[str, Places], seal: Callable[[Any], Case]) -> dict[str, Case]:
    """A case for each fault: the document with other values at its places, sealed as a right one is."""
    return {what: seal(edited(document, places)) for what, places in faults.items()}


def change_json(rng: Random, value: Any) -> Any:
    """A copy of a JSON value with one place changed: another value, one from elsewhere, or none."""
    value = json.loads(json.dumps(value))
    trails = _trails(value)
    if not trails:
        return rng.choice(JSON_VALUES)
    trail = rng.choice(trails)
    if rng.random() < 0.3:  # the outer keys are few, and lists are long
        trail = trail[: rng.randint(1, len(trail))]
    holder = value
    for key in trail[:-1]:
        holder = holder[key]
    key, old = trail[-1], holder[trail[-1]]
    way = rng.randrange(11)
    if way == 0:
        del holder[key]
    elif way == 1 and isinstance(holder, list):
        holder.insert(key, old)
    elif way == 1 and isinstance(holder, dict):
        holder[rng.choice((key + "x", "", "version", "count"))] = old
    elif way in (2, 3) and isinstance(old, int | float) and not isinstance(old, bool):
        holder[key] = rng.choice((old + 1, old - 1, -old, old * 2, old * 1.5, old * 1e6, str(old), float(old), [old]))
    elif way == 4:
        holder[key] = _at(value, rng.choice(trails))
    elif way == 9 and type(old) in (int, float):  # nearly what another place says
        numbers = [found for each in trails if type(found := _find(value, each)) in (int, float)]
        holder[key] = rng.choice(numbers) + rng.choice((-1, 0, 1))
    elif way == 10:  # two places exchange what they say
        other = rng.choice(trails)
        if other[: len(trail)] != trail and trail[: len(other)] != other:
            holder[key] = _at(value, other)
            _find(value, other[:-1])[other[-1]] = old
    elif way == 5 and isinstance(old, str):
        holder[key] = rng.choice((old + "x", old[:-1], old.upper(), old * 3, old[::-1], "../" + old))
    elif way == 5 and isinstance(old, list) and old:
        holder[key] = rng.choice((old[:-1], old + old, old[::-1], [*old, None], [old]))
    else:
        holder[key] = rng.choice(JSON_VALUES)
    return value


def _trails(value: Any, trail: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Keys that lead to the values of a document; of long lists only the first and last entries."""
    found = [trail] if trail else []
    pairs: list[tuple[Any, Any]] = []
    if isinstance(value, dict):
        pairs = list(value.items())
    elif isinstance(value, list):
        pairs = [
            (k, value[k]) for k in sorted({*range(min(3, len(value))), *range(max(0, len(value) - 1), len(value))})
        ]
    for key, inner in pairs:
        found += _trails(inner, (*trail, key))
    return found


def _find(value: Any, trail: tuple[Any, ...]) -> Any:
    for key in trail:
        value = value[key]
    return value


def _at(value: Any, trail: tuple[Any, ...]) -> Any:
    return json.loads(json.dumps(_find(value, trail)))
