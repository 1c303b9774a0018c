"""Worlds of the same street are prepared again and again: its up axis and the spaces of its tiles are found once."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.known_spaces import remember_spaces

MEASURED = {"test_memory", "test_tiles", "test_tiling"}
"""Files that find all anew, since they measure what that takes or look at how it is found."""


@pytest.fixture(scope="module", autouse=True)
def known_spaces(request: pytest.FixtureRequest, shared_folder: Path) -> Iterator[None]:
    if request.module.__name__.rpartition(".")[2] in MEASURED:
        yield
        return
    with remember_spaces(shared_folder):
        yield
