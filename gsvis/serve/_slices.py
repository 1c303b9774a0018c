"""Bytes of a WebSocket on their way to its parser: in slices, so that a burst of small frames keeps nobody waiting."""

from __future__ import annotations

from collections.abc import Callable

from gsvis.serve._line import Line
from gsvis.serve.turns import Readings

__all__ = ["Slices"]

_SLICE = 1 << 9  # most bytes that are parsed in one go; 5,000 empty frames take 50 ms


class Slices:
    """Hands bytes to a parser: at once if they are few, else a slice in each turn, while reading pauses.

    Args:
        line: The connection; its transport pauses.
        readings: Turns in which slices are parsed.
        parse: Parses some bytes; returns whether the connection goes on.
    """

    def __init__(self, line: Line, readings: Readings, parse: Callable[[bytes], bool]) -> None:
        self._line = line
        self._readings = readings
        self._parse = parse
        self._waiting = bytearray()
        self._is_held = False

    def add(self, data: bytes) -> None:
        """Hand over bytes, now or later."""
        if not self._waiting and len(data) <= _SLICE:
            self._parse(data)
            return
        if not self._waiting:
            self._line.transport.pause_reading()
            self._readings.add(self._parse_slice)
        self._waiting += data

    def hold(self, is_held: bool) -> None:
        """Pause or resume reading for the protocol; slices that are on their way to it still arrive."""
        self._is_held = is_held
        if is_held:
            self._line.transport.pause_reading()
        elif not self._waiting:
            self._line.transport.resume_reading()

    def clear(self) -> None:
        """Discard what has not been handed over."""
        self._waiting.clear()

    def _parse_slice(self) -> bool:
        """Hand over a slice; return whether there is more."""
        if not self._waiting or not self._parse(bytes(self._waiting[:_SLICE])):
            return False
        del self._waiting[:_SLICE]
        if self._waiting:
            return True
        if not self._is_held:
            self._line.transport.resume_reading()
        return False
