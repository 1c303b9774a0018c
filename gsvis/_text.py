r"""Escape text from outside, such as file names, so that it is safe to print and to write.

Control characters act on a terminal; file names that are not UTF-8 contain surrogates, which cannot be written; and
direction marks can disguise a name. All of them become escapes: `\x1b`, `\udce9`, `\u202e`.
"""

from __future__ import annotations

import json
import re
from typing import Any

__all__ = ["as_json", "as_line", "as_text"]

_DISGUISES = "\u2028-\u202e\u2066-\u2069"  # line breaks and direction marks
_SURROGATES = "\ud800-\udfff"
_UNREADABLE = re.compile(f"[\x00-\x08\x0b-\x1f\x7f-\x9f{_DISGUISES}{_SURROGATES}]")
_NOT_IN_A_LINE = re.compile(f"[\x00-\x1f\x7f-\x9f{_DISGUISES}{_SURROGATES}]")
_NOT_IN_JSON = re.compile(f"[\x7f-\x9f{_DISGUISES}{_SURROGATES}]")  # characters that `json` leaves as they are


def as_text(text: str) -> str:
    r"""Return text with unsafe characters escaped, but not line feeds and tabs.

    Examples:
        >>> as_text("caf\udce9\x1b[2J.ply")
        'caf\\udce9\\x1b[2J.ply'
    """
    return _UNREADABLE.sub(_escape, text)


def as_line(text: str) -> str:
    r"""Return text on one line: like `as_text`, with line feeds and tabs escaped too."""
    return _NOT_IN_A_LINE.sub(_escape, text)


def as_json(value: Any, *, indent: int | None = None) -> str:
    r"""Return a value as JSON text that is safe to print and to write as UTF-8; parsing it gives the same value.

    Raises:
        ValueError: If the value holds NaN or infinity.

    Examples:
        >>> as_json({"name": "caf\udce9 \x1b"})
        '{"name": "caf\\udce9 \\u001b"}'
    """
    text = json.dumps(value, indent=indent, ensure_ascii=False, allow_nan=False)
    return _NOT_IN_JSON.sub(lambda found: f"\\u{ord(found[0]):04x}", text)


def _escape(found: re.Match[str]) -> str:
    """Return the Python escape of a matched character."""
    return found[0].encode("unicode_escape").decode("ascii")
