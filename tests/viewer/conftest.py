"""One Chromium and one server for the tests of a file: they start more slowly than most tests run."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

from tests.viewer.browser import FLAGS, running
from tests.viewer.page_server import build_page, serve_page


@pytest.fixture(scope="module")
def browser(request: pytest.FixtureRequest) -> Iterator[Any]:
    """Chromium that draws with WebGL, without a GPU; with the flags `CHROMIUM` of the file, if it has any."""
    with running(getattr(request.module, "CHROMIUM", FLAGS)) as started:
        yield started


@pytest.fixture(scope="module")
def address(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """Address of a server with the page."""
    with serve_page(build_page(tmp_path_factory.mktemp("page"))) as url:
        yield url
