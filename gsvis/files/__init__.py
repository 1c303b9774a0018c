"""Bytes on disk that are no scene: atomic writes, locks, the Arrow container, limits, caches, kept results."""

_MODULES = ("archive", "arrow", "atomic", "cache", "fields", "kept", "limits", "locks", "output", "sections")


def __dir__() -> list[str]:
    return list(_MODULES)
