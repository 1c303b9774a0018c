"""What is decoded once and kept for further queries; the least recently used go first when bytes run out."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Hashable
from typing import Any, Protocol

__all__ = ["Cache"]


class Sized(Protocol):
    """An array, or whatever else says how many bytes it takes."""

    @property
    def nbytes(self) -> int:
        """Bytes in memory."""
        ...


class Cache:
    """Values by key, at most `max_bytes` of them; may be used from several threads.

    Args:
        max_bytes: A value larger than this is not kept at all.
    """

    def __init__(self, max_bytes: int) -> None:
        self.max_bytes, self.nbytes = max_bytes, 0
        self._values: OrderedDict[Hashable, Sized] = OrderedDict()
        self._lock = threading.Lock()

    def __len__(self) -> int:
        return len(self._values)

    def find(self, key: Hashable) -> Any:
        """Return the value kept under a key, or None."""
        with self._lock:
            if key in self._values:
                self._values.move_to_end(key)
            return self._values.get(key)

    def keep(self, key: Hashable, value: Sized) -> None:
        """Keep a value; older ones make room."""
        with self._lock:
            if key in self._values or value.nbytes > self.max_bytes:
                return
            self._values[key] = value
            self.nbytes += value.nbytes
            while self.nbytes > self.max_bytes:
                self.nbytes -= self._values.popitem(last=False)[1].nbytes

    def clear(self) -> None:
        """Forget all values."""
        with self._lock:
            self._values.clear()
            self.nbytes = 0
