"""Browsers that nobody looks at, which visit a page and report what the page has gathered: Chromium and Firefox.

Chromium is driven by Playwright; Firefox ESR, whose Playwright build is another, by WebDriver BiDi over its own socket.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from _harness import need

__all__ = ["visits"]

FLAGS = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader")
SIZE = {"width": 640, "height": 360}
OPEN = 2.5  # seconds that a window stands open before a visit: its own start would take both cores from the page
Visit = Callable[[str, str, float, Callable[[], None]], list[dict[str, Any]]]


@contextmanager
def visits(name: str) -> Iterator[Visit]:
    """A function that visits an address in a window that stands open, and returns `window.arrived` after some seconds.

    It takes the address, a script to run in the page, seconds, and what to call right before it navigates.
    """
    with _chromium() if name == "chromium" else _firefox() as visit:
        yield visit


@contextmanager
def _chromium() -> Iterator[Visit]:
    from playwright.sync_api import sync_playwright

    path = shutil.which("chromium")
    need(path, "Chromium on the PATH")
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=list(FLAGS))

        def visit(url: str, script: str, seconds: float, begin: Callable[[], None]) -> list[dict[str, Any]]:
            context = browser.new_context(viewport=SIZE)  # with a cache of its own
            page = context.new_page()
            page.add_init_script(script)
            page.wait_for_timeout(1000 * OPEN)
            begin()
            page.goto(url, wait_until="commit")
            page.wait_for_timeout(1000 * seconds)
            found = json.loads(page.evaluate("JSON.stringify(window.arrived)"))
            context.close()
            return list(found)

        yield visit
        browser.close()


class _Bidi:
    """A connection to Firefox by WebDriver BiDi."""

    def __init__(self, url: str) -> None:
        from websockets.sync.client import connect

        self._socket = connect(url, max_size=1 << 30)
        self._number = 0

    def ask(self, method: str, **given: Any) -> dict[str, Any]:
        """Send a command and return its result."""
        self._number += 1
        self._socket.send(json.dumps({"id": self._number, "method": method, "params": given}))
        while True:
            said = json.loads(self._socket.recv(timeout=60))
            if said.get("id") == self._number:
                if said["type"] != "success":
                    raise RuntimeError(f"{method}: {said.get('message')}")
                return dict(said["result"])


@contextmanager
def _firefox() -> Iterator[Visit]:
    path = shutil.which("firefox-esr")
    need(path, "Firefox ESR on the PATH")
    need(os.environ.get("DISPLAY"), "a display, such as that of xvfb-run: Firefox without one offers no WebGL2")
    with tempfile.TemporaryDirectory() as profile:
        words = [str(path), "--remote-debugging-port", "0", "--profile", profile, "--no-remote"]
        process = subprocess.Popen(words, stderr=subprocess.PIPE, text=True)
        try:
            assert process.stderr is not None
            url = ""
            while not url:
                line = process.stderr.readline()
                found = re.search(r"WebDriver BiDi listening on (ws://\S+)", line)
                url = f"{found[1]}/session" if found else ""
            bidi = _Bidi(url)
            bidi.ask("session.new", capabilities={})

            def visit(url: str, script: str, seconds: float, begin: Callable[[], None]) -> list[dict[str, Any]]:
                user = bidi.ask("browser.createUserContext")["userContext"]  # with a cache of its own
                context = bidi.ask("browsingContext.create", type="tab", userContext=user)["context"]
                bidi.ask("browsingContext.setViewport", context=context, viewport=SIZE)
                added = bidi.ask(
                    "script.addPreloadScript", functionDeclaration=f"() => {{{script}}}", contexts=[context]
                )
                time.sleep(OPEN)
                begin()
                bidi.ask("browsingContext.navigate", context=context, url=url, wait="none")
                time.sleep(seconds)
                said = bidi.ask(
                    "script.evaluate", expression="JSON.stringify(window.arrived)", target={"context": context},
                    awaitPromise=False,
                )  # fmt: skip
                bidi.ask("script.removePreloadScript", script=added["script"])
                bidi.ask("browser.removeUserContext", userContext=user)
                return list(json.loads(said["result"]["value"]))

            yield visit
        finally:
            process.terminate()
            process.wait()
