"""One Chromium for the tests of a file: to start it takes longer than most of them. Each test has its own context."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

from tests.viewer.browser import running


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """Chromium that draws with WebGL, without a GPU."""
    with running() as started:
        yield started
