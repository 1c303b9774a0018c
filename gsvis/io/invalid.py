"""Find rows of a scene that hold no numbers, and say whether readers leave such rows out or refuse the file.

The choice belongs to one call of a reader, or to one command, and reaches every format: `dropping_invalid` is a
context, so that formats inside formats follow it too. It is not seen by other threads.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

__all__ = ["REMEDY", "Dropping", "dropping_invalid", "find_invalid", "is_dropping"]

REMEDY = "--drop-invalid, or load_scene(..., drop_invalid=True), leaves such rows out"
"""Remedy of every error about such rows."""


class Dropping(NamedTuple):
    """Whether readers leave invalid rows out, and whether they say how many."""

    drops: bool = False
    quiet: bool = False


_CHOICE: ContextVar[Dropping] = ContextVar("dropping_invalid", default=Dropping())  # noqa: B039  immutable


@contextmanager
def dropping_invalid(drops: bool = True, *, quiet: bool = False) -> Iterator[None]:
    """Have readers leave invalid rows out, or not, inside the context.

    Args:
        drops: Whether they leave such rows out.
        quiet: Whether they do not report it, because the caller does.
    """
    token = _CHOICE.set(Dropping(drops, quiet))
    try:
        yield
    finally:
        _CHOICE.reset(token)


def is_dropping() -> Dropping:
    """Return the choice of the innermost context; outside of any, files with invalid rows are refused."""
    return _CHOICE.get()


def find_invalid(arrays: dict[str, NDArray[np.floating[Any]]]) -> NDArray[np.bool_]:
    """Return (N,) whether a Gaussian has a value that no Gaussian can have.

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
