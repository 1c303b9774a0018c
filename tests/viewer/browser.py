"""A real browser for tests of the viewer: Chromium, without a GPU by default, and a file server for one page.

`GSVIS_CHROMIUM` names another Chromium, `GSVIS_CHROMIUM_FLAGS` other flags, such as those of a machine with a GPU.
"""

from __future__ import annotations

import os
import shutil
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[2]
_SOFTWARE = "--use-angle=swiftshader --enable-unsafe-swiftshader --ignore-gpu-blocklist --disable-gpu-rasterization"
FLAGS = tuple(os.environ.get("GSVIS_CHROMIUM_FLAGS", _SOFTWARE).split())
MEASURED = ("--enable-blink-features=ForceEagerMeasureMemory",)  # for `measureUserAgentSpecificMemory` without a wait


def chromium() -> str:
    """Return the path of Chromium; skip where there is none."""
    pytest.importorskip("playwright.sync_api", reason="no playwright: pip install playwright")
    found = os.environ.get("GSVIS_CHROMIUM") or shutil.which("chromium") or shutil.which("chromium-browser")
    if not found:
        pytest.skip("no Chromium: install it, or set GSVIS_CHROMIUM to its path")
    return found


def viewer_files() -> Path:
    """Return the folder of the built viewer; skip where it is not built."""
    folder = Path(os.environ.get("GSVIS_VIEWER_FILES", ROOT / "gsvis" / "viewer"))
    if not (folder / "gsvis-viewer.js").is_file():
        pytest.skip(f"no viewer in {folder}: build it with npm run build in viewer/")
    return folder


class _Quiet(SimpleHTTPRequestHandler):
    def log_message(self, format: str, *args: object) -> None:
        pass

    def end_headers(self) -> None:
        # With these two a page may measure its memory.
        self.send_header("Cross-Origin-Opener-Policy", "same-origin")
        self.send_header("Cross-Origin-Embedder-Policy", "require-corp")
        super().end_headers()

    extensions_map = {**SimpleHTTPRequestHandler.extensions_map, ".js": "text/javascript"}


@contextmanager
def served(folder: Path) -> Iterator[str]:
    """Serve a folder; gives its address."""
    with ThreadingHTTPServer(("127.0.0.1", 0), partial(_Quiet, directory=str(folder))) as server:
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        try:
            yield f"http://127.0.0.1:{server.server_address[1]}"
        finally:
            server.shutdown()
            thread.join()


@contextmanager
def running(flags: tuple[str, ...] = FLAGS) -> Iterator[Any]:
    """Start Chromium; gives the browser."""
    path = chromium()
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=list(flags))
        try:
            yield browser
        finally:
            browser.close()


@contextmanager
def page_in(browser: Any, address: str, **context: Any) -> Iterator[tuple[Any, list[str]]]:
    """Open an address in a context of its own; gives the page and what it says on its console, errors included."""
    opened = browser.new_context(**context)
    try:
        page = opened.new_page()
        said: list[str] = []
        page.on("console", lambda message: said.append(f"{message.type}: {message.text}"))
        page.on("pageerror", lambda error: said.append(f"error: {error}"))
        page.goto(address)
        yield page, said
    finally:
        opened.close()


@contextmanager
def browser_page(address: str, **context: Any) -> Iterator[tuple[Any, list[str]]]:
    """Open an address in a browser of its own, which can measure its memory; gives what `page_in` does."""
    with running((*FLAGS, *MEASURED)) as browser, page_in(browser, address, **context) as found:
        yield found
