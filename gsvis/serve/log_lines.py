"""Formatters of `logging` for a server: lines for people, or one JSON object a line for a collector.

    handler.setFormatter(JsonLines())
    logging.getLogger("gsvis").addHandler(handler)

Events of a server carry their facts apart from their text, so both say the same. Times are UTC.
"""

from __future__ import annotations

import json
import logging
import math
import time
from numbers import Integral, Real

__all__ = ["JsonLines", "TextLines"]

_DATE = "%Y-%m-%dT%H:%M:%S"


class TextLines(logging.Formatter):
    """Writes a time, a level, and the message.

    Args:
        process: Number of the process, as the last fact of each line; None leaves it out.

    Examples:
        2026-11-21T14:12:03.120Z INFO closed client=3 reason=left seconds=31.2
    """

    def __init__(self, process: int | None = None) -> None:
        end = "" if process is None else f" process={process}"
        super().__init__(f"%(asctime)s.%(msecs)03dZ %(levelname)s %(message)s{end}", _DATE)
        self.converter = time.gmtime


class JsonLines(logging.Formatter):
    """Writes one JSON object a line: `time`, `level`, `event` and its facts.

    Lines of other libraries have `event` "log", `logger` and `message`. A traceback is `traceback`.

    Args:
        process: Number of the process, as `process`; None leaves it out.

    Examples:
        {"time": "2026-11-21T14:12:03.120Z", "level": "INFO", "event": "closed", "client": 3, "reason": "left"}
    """

    def __init__(self, process: int | None = None) -> None:
        super().__init__()
        self.converter = time.gmtime
        self._process = process

    def format(self, record: logging.LogRecord) -> str:
        """Return the line of a record."""
        found: dict[str, object] = {
            "time": f"{self.formatTime(record, _DATE)}.{int(record.msecs):03d}Z",
            "level": record.levelname,
            "event": getattr(record, "event", "log"),
        }
        facts = getattr(record, "facts", None)
        if facts is None:
            facts = {"logger": record.name, "message": record.getMessage()}
        for key, value in facts.items():
            if value is not None:
                found.setdefault(key, _json(value))
        if self._process is not None:
            found.setdefault("process", self._process)
        if record.exc_info:
            found["traceback"] = self.formatException(record.exc_info)
        return json.dumps(found)


def _json(value: object) -> object:
    """Return a value as JSON knows it; floats to four digits, as in the lines for people."""
    if isinstance(value, bool | str):
        return value
    if isinstance(value, Integral):
        return int(value)
    if isinstance(value, Real) and math.isfinite(rounded := float(f"{float(value):.4g}")):
        return rounded
    return str(value)
