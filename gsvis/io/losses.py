"""Report what a reader or a writer lost because the file cannot store it, one line per property.

Readers and writers call `report_loss`; the line goes to the logger `gsvis.io` with the `Loss` attached, the command
line prints it, and `watch_losses` collects it. `report_note` is for lines about a file that lose nothing.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gsvis.files.shown import shown_name

__all__ = ["LOGGER", "Loss", "report_clipped", "report_loss", "report_note", "watch_losses"]

LOGGER = "gsvis.io"
"""Name of the logger of readers and writers."""

_logger = logging.getLogger(LOGGER)


@dataclass(frozen=True)
class Loss:
    """One property that was not kept.

    Attributes:
        path: The file that was read or written.
        what: Name of the property: "centers", "scales", "opacities", "colors", "SH", "rows", "order", "antialiased" or
            another fact.
        text: What happened to it, as a sentence without the path.
        count: Number of Gaussians affected; 0 if it affects all of them or the file as a whole.
    """

    path: str
    what: str
    text: str
    count: int = 0


def report_loss(path: str | os.PathLike[str], what: str, text: str, count: int = 0) -> None:
    """Log a loss as one line.

    Args:
        path: The file that is read or written; an empty path logs nothing, because the caller reports.
        what: The property, as in `Loss`.
        text: What happened to it.
        count: Number of Gaussians affected.
    """
    loss = Loss(shown_name(path), what, text, count)
    if not loss.path:
        return
    _logger.warning("%s: %s", loss.path, text, extra={"loss": loss})


def report_note(path: str | os.PathLike[str], text: str) -> None:
    """Log a line about a file, without a loss."""
    _logger.warning("%s: %s", shown_name(path), text)


def report_clipped(
    path: str | os.PathLike[str], what: str, beyond: NDArray[np.floating], limits: str, unit: str = ""
) -> None:
    """Log how many values a format clipped, and by how much; nothing if it clipped none.

    Args:
        path: The file.
        what: The property, as in `Loss`.
        beyond: (N,) or (N, K) distance of each value from the range of the format; 0 inside.
        limits: The range, for the message.
        unit: Unit of the distance.
    """
    most = float(beyond.max(initial=0.0))
    if most <= 0.0:
        return
    count = int((beyond.reshape(len(beyond), -1) > 0.0).any(axis=1).sum())
    text = f"{what} of {count:,} Gaussians are clipped to {limits}, by up to {most:.3g}{unit and ' ' + unit}"
    report_loss(path, what, text, count)


class _Collector(logging.Handler):
    """Collect the losses attached to log records."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.losses: list[Loss] = []

    def emit(self, record: logging.LogRecord) -> None:
        """Keep the loss of a log record, if it has one."""
        loss = getattr(record, "loss", None)
        if isinstance(loss, Loss):
            self.losses.append(loss)


@contextmanager
def watch_losses() -> Iterator[list[Loss]]:
    """Collect the losses that are reported inside the context, in all threads.

    Examples:
        >>> with watch_losses() as losses:
        ...     report_loss("out.spz", "antialiased", "the flag is lost")
        >>> [loss.what for loss in losses]
        ['antialiased']
    """
    collector = _Collector()
    _logger.addHandler(collector)
    try:
        yield collector.losses
    finally:
        _logger.removeHandler(collector)
