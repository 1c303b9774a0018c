"""Cache data that was read or decoded; the least recently used values are removed when the cache is too large."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable
from typing import Any, Generic, TypeVar

__all__ = ["Cache"]

_Value = TypeVar("_Value")


class Cache(Generic[_Value]):
    """Values by key; threads may share it.

    Args:
        max_bytes: Most bytes of all values together. A larger value is not kept, unless `keep_last`. None sets no
            limit.
        max_items: Most values. None sets no limit.
        keep_last: Always keep the last value, whatever its size.

    Attributes:
        nbytes: Bytes of the kept values.
    """

    def __init__(self, max_bytes: int | None = None, *, max_items: int | None = None, keep_last: bool = False) -> None:
        self.max_bytes = max_bytes
        self.max_items = max_items
        self.nbytes = 0
        self._keep_last = keep_last
        self._values: OrderedDict[Hashable, tuple[_Value, int]] = OrderedDict()
        self._lock = threading.Lock()

    def __len__(self) -> int:
        return len(self._values)

    @property
    def fill(self) -> float:
        """Share of `max_bytes` in use; 0 without a limit."""
        return self.nbytes / max(1, self.max_bytes) if self.max_bytes is not None else 0.0

    def find(self, key: Hashable) -> _Value | None:
        """Return the value of a key, or None."""
        with self._lock:
            found = self._values.get(key)
            if found is None:
                return None
            self._values.move_to_end(key)
            return found[0]

    def keep(self, key: Hashable, value: _Value, nbytes: int | None = None) -> None:
        """Keep a value; the least recently used values are removed if there is no room.

        Args:
            key: The key. If it has a value already, that value stays.
            value: The value.
            nbytes: Size of the value; None takes its attribute `nbytes`.
        """
        size = _size_of(value) if nbytes is None else nbytes
        with self._lock:
            too_large = self.max_bytes is not None and size > self.max_bytes and not self._keep_last
            if key in self._values or too_large:
                return
            self._values[key] = value, size
            self.nbytes += size
            while self._is_too_full():
                self.nbytes -= self._values.popitem(last=False)[1][1]

    def find_or_make(self, key: Hashable, make: Callable[[], _Value]) -> _Value:
        """Return the value of a key, or make and keep it; two threads may both make it."""
        found = self.find(key)
        if found is None:
            found = make()
            self.keep(key, found)
        return found

    def scope(self, name: Hashable) -> Cache[_Value]:
        """Return a view of this cache with its own names."""
        return _Named(self, name)

    def clear(self) -> None:
        """Remove all values."""
        with self._lock:
            self._values.clear()
            self.nbytes = 0

    def _is_too_full(self) -> bool:
        """Return whether the values exceed a limit."""
        if self._keep_last and len(self._values) == 1:
            return False
        over_bytes = self.max_bytes is not None and self.nbytes > self.max_bytes
        return over_bytes or (self.max_items is not None and len(self._values) > self.max_items)


class _Named(Cache[_Value]):
    """A view of a cache with its own names."""

    def __init__(self, of: Cache[_Value], name: Hashable) -> None:
        super().__init__()
        self._of = of
        self._name = name

    def find(self, key: Hashable) -> _Value | None:
        return self._of.find((self._name, key))

    def keep(self, key: Hashable, value: _Value, nbytes: int | None = None) -> None:
        self._of.keep((self._name, key), value, nbytes)


def _size_of(value: Any) -> int:
    return int(getattr(value, "nbytes", 0))
