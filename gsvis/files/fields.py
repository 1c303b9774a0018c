"""Read JSON with checked types: each value is checked for type and range when it is read; errors name its place.

A `Fields` is one object of a file and the keys that lead to it. This module knows no format.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsvis.errors import FormatError
from gsvis.files.limits import Budget

__all__ = ["Fields", "estimate_parsed_bytes", "parse_json", "parse_object"]

# Most bytes of memory for each kind of JSON value and for each character (measured in tests).
_OBJECT = 256
_LIST = 128
_VALUE = 88
_CHARACTER = 8


def estimate_parsed_bytes(data: bytes) -> int:
    """Return an upper bound of the memory for parsed JSON text, in bytes, without parsing it.

    Every value but the first has a comma, a colon or a bracket before it. Characters inside strings count too.
    """
    values = data.count(b",") + data.count(b":") + 1
    return _OBJECT * data.count(b"{") + _LIST * data.count(b"[") + _VALUE * values + _CHARACTER * len(data)


def parse_json(path: str | os.PathLike[str], data: bytes, budget: Budget | None = None, **options: Any) -> Any:
    """Return the value of JSON text; claim its memory before it is parsed.

    Args:
        path: The file, for messages.
        data: The text.
        budget: Memory budget to claim from; None makes one from the size of the text.
        **options: Passed to `json.loads`.

    Raises:
        FormatError: If the text is no JSON, nested too deeply, or needs more memory than the budget has.
    """
    (Budget(path, len(data)) if budget is None else budget).claim(estimate_parsed_bytes(data), "JSON")
    try:
        return json.loads(data, **options)
    except RecursionError as error:
        raise FormatError(path, "", "JSON", "objects nested too deeply") from error
    except ValueError as error:  # includes JSONDecodeError, UnicodeDecodeError and integers with too many digits
        got = "text that is not UTF-8" if isinstance(error, UnicodeDecodeError) else str(error)
        raise FormatError(path, "", "JSON", got, "is the file truncated?") from error


def parse_object(path: str | os.PathLike[str], data: bytes, budget: Budget | None = None) -> Fields:
    """Return the object of JSON text.

    Args:
        path: The file, for messages.
        data: The text.
        budget: Memory budget to claim from; None makes one from the size of the text.

    Raises:
        FormatError: If the text is no JSON object, nested too deeply, or needs more memory than the budget has.
    """
    return Fields(path, "", parse_json(path, data, budget))


class Fields:
    """One JSON object and its place in a file.

    Args:
        path: The file, for error messages.
        trail: Keys that lead to the object, such as `shN`; empty for the outermost object.
        value: The value at this place.

    Raises:
        FormatError: If `value` is no object.
    """

    def __init__(self, path: str | os.PathLike[str], trail: str, value: Any) -> None:
        self.path = path
        self.trail = trail
        if not isinstance(value, dict):
            raise FormatError(path, trail, "an object", _spell(value))
        self.value: dict[str, Any] = value

    def where(self, key: str) -> str:
        """Return the trail of a key, for error messages."""
        return f"{self.trail}.{key}" if self.trail else key

    def __contains__(self, key: str) -> bool:
        return self.value.get(key) is not None

    def raw(self, key: str) -> Any:
        """Return the unchecked value at a key; None if the key is missing."""
        return self.value.get(key)

    def text(self, key: str, choices: Iterable[str] | None = None) -> str:
        """Return the string at a key: one of the choices, or any string that UTF-8 can encode."""
        value = self.raw(key)
        known = None if choices is None else tuple(choices)
        if not isinstance(value, str) or not _is_utf8(value) or (known is not None and value not in known):
            wanted = "a string" if known is None else f"one of {', '.join(known)}"
            raise FormatError(self.path, self.where(key), wanted, _spell(value))
        return value

    def child(self, key: str) -> Fields:
        """Return the object at a key."""
        return Fields(self.path, self.where(key), self.raw(key))

    def integer(self, key: str, low: int, high: int) -> int:
        """Return the integer at a key, in [low, high]; 3.0 counts as 3."""
        value = self.raw(key)
        if isinstance(value, float) and value.is_integer():
            value = int(value)
        if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
            raise FormatError(self.path, self.where(key), f"an integer from {low} to {high}", _spell(value))
        return value

    def number(self, key: str) -> float:
        """Return the finite number at a key."""
        return float(self._numbers(key, [self.raw(key)])[0])

    def numbers(self, key: str, length: int | None = None) -> NDArray[np.float64]:
        """Return the list of finite numbers at a key; None allows any length."""
        return self._numbers(key, self.items(key, length))

    def items(self, key: str, length: int | None = None) -> list[Any]:
        """Return the list at a key; None allows any length."""
        value = self.raw(key)
        if not isinstance(value, list) or (length is not None and len(value) != length):
            wanted = "a list" if length is None else f"a list of {length}"
            raise FormatError(self.path, self.where(key), wanted, _spell(value))
        return value

    def _numbers(self, key: str, values: list[Any]) -> NDArray[np.float64]:
        """Return the checked numbers of a list."""
        for value in values:
            good = isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e300
            if not good or not math.isfinite(value):
                raise FormatError(self.path, self.where(key), "finite numbers", _spell(value))
        return np.array(values, dtype=np.float64)


def _is_utf8(text: str) -> bool:
    """Return whether UTF-8 can encode the text; JSON can hold half of a surrogate pair."""
    try:
        text.encode()
    except UnicodeEncodeError:
        return False
    return True


def _spell(value: Any) -> str:
    """Describe a JSON value in a few words."""
    if value is None:
        return "nothing"
    if isinstance(value, list):
        return f"a list of {len(value)}"
    if isinstance(value, dict):
        return "an object"
    text = repr(value) if not isinstance(value, int) or abs(value) < 10**30 else "an enormous number"
    return text if len(text) <= 60 else text[:57] + "..."
