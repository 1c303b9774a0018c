"""Bytes on disk apart from scenes: atomic writes, locks, the Arrow container, limits, caches, one way to resume."""

_MODULES = (
    "apart",
    "archive",
    "arrow",
    "atomic",
    "cache",
    "fields",
    "folders",
    "joined",
    "limits",
    "locks",
    "objects",
    "origins",
    "mapped",
    "output",
    "places",
    "resume",
    "sections",
    "shelf",
    "sums",
    "swap",
    "temporary",
)


def __dir__() -> list[str]:
    return list(_MODULES)
