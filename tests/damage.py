"""Documents with one value replaced: what every reader of JSON has to refuse, or to read, in a line."""

from __future__ import annotations

import copy
from collections.abc import Iterator
from typing import Any

OTHERS: dict[str, Any] = {
    "null": None, "true": True, "false": False, "zero": 0, "minus one": -1, "one": 1, "three": 3, "3.0": 3.0,
    "half": 0.5, "huge": 1e308, "minus huge": -1e308, "NaN": float("nan"), "infinity": float("inf"), "tiny": 5e-324,
    "2^31 - 1": 2**31 - 1, "2^63": 2**63, "10^40": 10**40, "empty text": "", "text": "x", "half a character": "\ud800",
    "long text": "a" * 3000, "zeros": "0" * 64, "a variant": "rgb", "control characters": "a\n\x1b[31m\0",
    "empty list": [], "list of a list": [[]], "list": [1], "list of three": [1, 2, 3], "list of text": ["x"],
    "list of nulls": [None] * 3, "list of an object": [{}], "empty object": {}, "object": {"x": 1},
    "object with a name": {"name": "x", "count": 1},
}  # fmt: skip
"""A value of every JSON type, small, large and strange."""


def places(value: Any, trail: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Trails of keys to all values of a document, the first of each list."""
    yield trail
    if isinstance(value, dict):
        for key, child in value.items():
            yield from places(child, (*trail, key))
    elif isinstance(value, list):
        for k, child in enumerate(value[:1]):
            yield from places(child, (*trail, k))


def replaced(value: Any, trail: tuple[Any, ...], other: Any) -> Any:
    """The document with another value at a trail."""
    if not trail:
        return other
    made = copy.deepcopy(value)
    place = made
    for key in trail[:-1]:
        place = place[key]
    place[trail[-1]] = other
    return made


def without(value: Any, trail: tuple[Any, ...]) -> Any:
    """The document without the value at a trail, which is not empty."""
    made = copy.deepcopy(value)
    place = made
    for key in trail[:-1]:
        place = place[key]
    del place[trail[-1]]
    return made
