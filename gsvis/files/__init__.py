"""Bytes on disk apart from scenes: atomic writes, locks, the Arrow container, limits, caches."""

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
    "origins",
    "mapped",
    "output",
    "places",
    "scratch",
    "sections",
    "shelf",
    "shown",
    "sums",
    "swap",
    "temporary",
)


def __dir__() -> list[str]:
    return list(_MODULES)
