"""Packages of tests, colored and measured on one small view instead of many. `python -m tests.few_views` is `gsvis`."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

__all__ = ["take_few_views"]


@contextmanager
def take_few_views() -> Iterator[None]:
    """Let `PrepareConfig` take one view where it takes many, unless it is told which."""
    from gsvis.prepare import PrepareConfig

    few = replace(PrepareConfig().cost_views, count=1, width=24, height=20)
    before = PrepareConfig.__init__

    def initialize(self: PrepareConfig, *words: Any, **named: Any) -> None:
        before(self, *words, **{"cost_views": few, "fidelity_views": few, "level_held_out": 1, **named})
        object.__setattr__(self, "colors", replace(self.colors, views=few))

    PrepareConfig.__init__ = initialize  # type: ignore[method-assign]
    try:
        yield
    finally:
        PrepareConfig.__init__ = before  # type: ignore[method-assign]


if __name__ == "__main__":
    from gsvis.cli import main

    with take_few_views():
        sys.exit(main(sys.argv[1:]))
