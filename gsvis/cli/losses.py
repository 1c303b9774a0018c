"""Print what readers and writers of scenes lose as lines on stderr, each once a command."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager

from gsvis.cli.terminal import say

__all__ = ["losses_on_stderr"]


class _Lines(logging.Handler):
    """Write each message once."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self._said: set[str] = set()

    def emit(self, record: logging.LogRecord) -> None:
        """Print a message once, on one line."""
        line = " ".join(record.getMessage().split())
        if line in self._said:
            return
        self._said.add(line)
        say(line)


@contextmanager
def losses_on_stderr() -> Iterator[None]:
    """Print the lines of the logger of readers and writers inside the context."""
    from gsvis.io.losses import LOGGER

    logger = logging.getLogger(LOGGER)
    lines = _Lines()
    before = logger.propagate
    logger.addHandler(lines)
    logger.propagate = False
    try:
        yield
    finally:
        logger.removeHandler(lines)
        logger.propagate = before
