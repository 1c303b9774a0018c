"""Log events: an event and its facts as key=value, always one line each, whatever a client sends.

The logger is "gsvis.serve". It never gets tokens, queries or headers.
"""

from __future__ import annotations

import json
import logging
import re
import time
from collections.abc import Callable

from gsvis.serve.limits import RateBucket

__all__ = ["LOGGER", "EventLog", "line_of"]

LOGGER = logging.getLogger("gsvis.serve")

_PLAIN = re.compile(r"[A-Za-z0-9_.:,/+@%\[\]()-]+")
_LONGEST = 300


def line_of(event: str, **facts: object) -> str:
    """Return one line of text.

    Examples:
        >>> line_of("closed", client=3, reason="no answer", seconds=1.23456)
        'closed client=3 reason="no answer" seconds=1.235'
    """
    return " ".join([event, *(f"{key}={_value(value)}" for key, value in facts.items() if value is not None)])


def _short(value: object) -> object:
    """Return a value; of a long text, its beginning."""
    return f"{value[:_LONGEST]}..." if isinstance(value, str) and len(value) > _LONGEST else value


def _value(value: object) -> str:
    """Return a value as text without spaces, or in quotes."""
    text = f"{value:.4g}" if isinstance(value, float) else str(_short(value))
    return text if _PLAIN.fullmatch(text) else json.dumps(text)


class EventLog:
    """Write lines, with a limit for each event; the next line counts those left out.

    Args:
        per_s: Most lines a second of one event; up to ten seconds' worth may come at once.
        clock: Function that returns seconds.
    """

    def __init__(self, per_s: float = 20.0, clock: Callable[[], float] = time.monotonic) -> None:
        self._per_s = per_s
        self._clock = clock
        self._buckets: dict[str, RateBucket] = {}
        self._left_out: dict[str, int] = {}

    def __call__(self, event: str, level: int = logging.INFO, /, **facts: object) -> None:
        """Write a line, unless there are too many."""
        bucket = self._buckets.setdefault(event, RateBucket(self._per_s, 10.0 * self._per_s))
        if not bucket.take(self._clock()):
            self._left_out[event] = self._left_out.get(event, 0) + 1
            return
        left_out = self._left_out.pop(event, None)
        facts = {key: _short(value) for key, value in facts.items()} | {"left_out": left_out}
        LOGGER.log(level, "%s", line_of(event, **facts), extra={"event": event, "facts": facts})
