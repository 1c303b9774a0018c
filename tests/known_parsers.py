"""The parser of a command, built once: building it takes most of the time of a command that does little.

Only for tests of what commands do, which run hundreds of them in one process.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest
from tyro._parsers import ParserSpecification

__all__ = ["remember_parsers"]


@contextmanager
def remember_parsers() -> Iterator[None]:
    """Let tyro build what it knows of a command once for each class of options. It depends on nothing else."""
    build = ParserSpecification.from_callable_or_type
    known: dict[Any, ParserSpecification] = {}

    def remember(f: Any, **options: Any) -> ParserSpecification:
        if options["parent_classes"]:  # a part of a command
            return build(f, **options)
        if f not in known:
            known[f] = build(f, **options)
        return known[f]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ParserSpecification, "from_callable_or_type", staticmethod(remember))
        yield
