"""Packages of tests, colored and measured on one small view instead of many.

`python -m tests.few_views` is `gsvis` with them, and with spaces of few voxels.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any
from unittest.mock import patch

__all__ = ["take_few_views"]


@contextmanager
def take_few_views() -> Iterator[None]:
    """Give `PrepareConfig` one view and one term by default and no learning of colors; what a caller passes counts."""
    from gsvis.color.fit import FitConfig
    from gsvis.prepare import PrepareConfig

    few = replace(PrepareConfig().cost_views, count=1, width=24, height=20)
    before = PrepareConfig.__init__

    def initialize(self: PrepareConfig, *words: Any, **named: Any) -> None:
        before(self, *words, **{"cost_views": few, "fidelity_views": few, "level_held_out": 1, **named})
        if self.color_steps is None:
            object.__setattr__(self, "color_steps", 0)
        fit = self.colors.fit
        fit = replace(fit, max_terms=1) if fit == FitConfig() else fit
        object.__setattr__(self, "colors", replace(self.colors, fit=fit, views=few))

    with patch.object(PrepareConfig, "__init__", initialize):
        yield


if __name__ == "__main__":
    from gsvis.cli import main
    from tests.known_spaces import coarse_spaces
    from tests.one_compiler import compile_once

    compile_once()
    with take_few_views(), coarse_spaces():
        sys.exit(main(sys.argv[1:]))
