r"""Write text from outside, such as the name of a file, so that it does nothing but be read.

A terminal obeys control characters, a name that is no UTF-8 holds surrogates that no file can hold, and marks of
direction make a name look like another. All of them become escapes here: `\x1b`, `\udce9`, `\u202e`.
"""

from __future__ import annotations

import json
import re
from typing import Any

__all__ = ["as_json", "as_line", "as_text"]

_DISGUISES = "\u2028-\u202e\u2066-\u2069"  # breaks of lines, and marks that turn the direction of text
_SURROGATES = "\ud800-\udfff"
_UNREADABLE = re.compile(f"[\x00-\x08\x0b-\x1f\x7f-\x9f{_DISGUISES}{_SURROGATES}]")
_NOT_IN_A_LINE = re.compile(f"[\x00-\x1f\x7f-\x9f{_DISGUISES}{_SURROGATES}]")
_NOT_IN_JSON = re.compile(f"[\x7f-\x9f{_DISGUISES}{_SURROGATES}]")  # what JSON need not escape


def as_text(text: str) -> str:
    r"""Return text with all but letters, line feeds and tabs escaped.

    Examples:
        >>> as_text("caf\udce9\x1b[2J.ply")
        'caf\\udce9\\x1b[2J.ply'
    """
    return _UNREADABLE.sub(_escape, text)


def as_line(text: str) -> str:
    r"""Return text on one line: as `as_text`, and line feeds and tabs are escaped too."""
    return _NOT_IN_A_LINE.sub(_escape, text)


def as_json(value: Any, *, indent: int | None = None) -> str:
    r"""Return a value as JSON text that UTF-8 can hold and a terminal can show; reading it gives the same value.

    Raises:
        ValueError: If the value holds NaN or infinity.

    Examples:
        >>> as_json({"name": "caf\udce9 \x1b"})
        '{"name": "caf\\udce9 \\u001b"}'
    """
    text = json.dumps(value, indent=indent, ensure_ascii=False, allow_nan=False)
    return _NOT_IN_JSON.sub(lambda found: f"\\u{ord(found[0]):04x}", text)


def _escape(found: re.Match[str]) -> str:
    return found[0].encode("unicode_escape").decode("ascii")
