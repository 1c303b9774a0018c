"""Decoded arrays kept for further queries: the least recently used go first when they take too many bytes."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Hashable
from typing import Any

from numpy.typing import NDArray

__all__ = ["Cache"]


class Cache:
    """Arrays by key, at most `max_bytes` of them; may be used from several threads.

    Args:
        max_bytes: An array larger than this is not kept at all.
    """

    def __init__(self, max_bytes: int) -> None:
        self.max_bytes, self.nbytes = max_bytes, 0
        self._arrays: OrderedDict[Hashable, NDArray[Any]] = OrderedDict()
        self._lock = threading.Lock()

    def __len__(self) -> int:
        return len(self._arrays)

    def find(self, key: Hashable) -> NDArray[Any] | None:
        """The array kept under a key, or None."""
        with self._lock:
            if key in self._arrays:
                self._arrays.move_to_end(key)
            return self._arrays.get(key)

    def keep(self, key: Hashable, array: NDArray[Any]) -> None:
        """Keep an array; older ones make room."""
        with self._lock:
            if key in self._arrays or array.nbytes > self.max_bytes:
                return
            self._arrays[key] = array
            self.nbytes += array.nbytes
            while self.nbytes > self.max_bytes:
                self.nbytes -= self._arrays.popitem(last=False)[1].nbytes

    def clear(self) -> None:
        """Forget all arrays."""
        with self._lock:
            self._arrays.clear()
            self.nbytes = 0
