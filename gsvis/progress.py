"""Progress of long work: a callback that the library calls and the CLI turns into a bar."""

from __future__ import annotations

from collections.abc import Callable

__all__ = ["Progress", "silent"]

Progress = Callable[[str, int, int], None]
"""`progress(stage, done, total)`: called with done = 0 at the start of a stage and done = total at its end.

It may raise, for example `KeyboardInterrupt`: the work then stops and leaves nothing half-written.
"""


def silent(stage: str, done: int, total: int) -> None:
    """Ignore progress."""
