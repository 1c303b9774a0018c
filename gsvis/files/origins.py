"""Parse origins of web pages, the other servers that a page may contact, into one spelling."""

from __future__ import annotations

import re
from collections.abc import Sequence

__all__ = ["connect_sources", "parse_origins"]

_ORIGIN = re.compile(
    r"https?://(?:[a-z0-9](?:[a-z0-9-]{0,61}[a-z0-9])?(?:\.[a-z0-9-]{1,63})*|\[[0-9a-f:]{2,45}\])(?::\d{1,5})?"
)


def parse_origins(name: str, given: Sequence[str]) -> tuple[str, ...]:
    """Return origins in lower case.

    Args:
        name: Name of the argument, for the error.
        given: Origins, such as "https://example.org" or "http://127.0.0.1:8000".

    Raises:
        ValueError: If one is no origin: with a path, a name of a user, or an asterisk.
    """
    origins = tuple(origin.lower() for origin in given)
    for origin in origins:
        if not _ORIGIN.fullmatch(origin):
            raise ValueError(
                f"{name}: expected origins such as https://example.org, got {origin[:100]!r}; name scheme, host and"
                " port alone"
            )
    return origins


def connect_sources(origins: Sequence[str]) -> str:
    """Return the value of `connect-src` for the policy of a page: its own origin, and others with their streams."""
    return " ".join(
        ["'self'", *(spelled for origin in origins for spelled in (origin, origin.replace("http", "ws", 1)))]
    )
