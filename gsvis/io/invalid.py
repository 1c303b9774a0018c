"""Find rows of a scene with invalid values, and choose whether readers drop such rows or reject the file.

`dropping_invalid` is a context, so that the choice of one call or one command applies to nested formats too. It does
not affect other threads.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

__all__ = ["REMEDY", "Dropping", "dropping_invalid", "find_invalid", "is_dropping"]

REMEDY = "--drop-invalid, or load_scene(..., drop_invalid=True), drops such rows"
"""Remedy of every error about such rows."""


class Dropping(NamedTuple):
    """Whether readers drop invalid rows, and whether they do so without a report."""

    drops: bool = False
    quiet: bool = False


_CHOICE: ContextVar[Dropping] = ContextVar("dropping_invalid", default=Dropping())  # noqa: B039  immutable


@contextmanager
def dropping_invalid(drops: bool = True, *, quiet: bool = False) -> Iterator[None]:
    """Make readers drop invalid rows, or reject them, inside the context.

    Args:
        drops: Whether readers drop such rows.
        quiet: Whether readers omit the report, because the caller makes it.
    """
    token = _CHOICE.set(Dropping(drops, quiet))
    try:
        yield
    finally:
        _CHOICE.reset(token)


def is_dropping() -> Dropping:
    """Return the choice of the innermost context; outside of any context, files with invalid rows are rejected."""
    return _CHOICE.get()


def find_invalid(arrays: dict[str, NDArray[np.floating[Any]]]) -> NDArray[np.bool_]:
    """Return an (N,) mask of Gaussians with an impossible value.

    Args:
        arrays: Activated values by the names of `Gaussians`; each has N rows.
    """
    bad = np.zeros(len(arrays["means"]), bool)
    with np.errstate(all="ignore"):
        for values in arrays.values():
            bad |= ~np.isfinite(values.reshape(len(bad), -1)).all(axis=1)
        bad |= ~(arrays["scales"] > 0.0).all(axis=1)
        bad |= ~((arrays["opacities"] >= 0.0) & (arrays["opacities"] <= 1.0))
    return bad
