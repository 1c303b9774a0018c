"""The page as it ships, in one Chromium without a GPU, with real scenes: keys, windows, servers that die, parts, VR."""

from __future__ import annotations

import io
import logging
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from gsvis.export import write_site
from tests import warm_start
from tests.serve.nginx import NGINX, free_port, nginx
from tests.serve.servers import PATIENCE, serving, until
from tests.stream.worlds import package_of
from tests.viewer.browser import served, viewer_files

pytestmark = pytest.mark.slow
WAIT = 1000 * PATIENCE
KINDS = Path("/etc/nginx/mime.types")
DRAWN = """() => document.documentElement.dataset.state === 'complete'
    && /[1-9]/.test(document.querySelector('.state').textContent)"""
ACTIONS = "iotcpgbr,.kmlx?"
ARROWS = ("ArrowLeft", "ArrowRight", "ArrowUp", "ArrowDown")
MOVES = (*"wasdqe+-", *ARROWS, "Shift+w", "PageUp", "PageDown", *"123456789")
Open = Callable[..., Any]

HEADSET = """
window.seen = [];
const eye = (x) => ({
    projectionMatrix: Float32Array.of(1.2, 0, 0, 0, 0, 1.2, 0, 0, 0, 0, -1, -1, 0, 0, -0.02, 0),
    transform: { position: { x, y: 0, z: 0 }, orientation: { x: 0, y: 0, z: 0, w: 1 } },
});
const eyes = [eye(-0.03), eye(0.03)];
window.XRWebGLLayer = class {
    constructor(session, gl) { this.framebuffer = null; window.gl = gl; }
    getViewport(view) { return { x: 120 * eyes.indexOf(view), y: 0, width: 120, height: 160 }; }
};
WebGL2RenderingContext.prototype.makeXRCompatible = async () => {};
class Session extends EventTarget {
    async requestReferenceSpace(type) { return { type }; }
    updateRenderState() {}
    requestAnimationFrame(step) {
        return requestAnimationFrame((time) => {
            step(time, { getViewerPose: () => ({ views: eyes }) });
            const bytes = new Uint8Array(4 * 240 * 160);
            gl.readPixels(0, 0, 240, 160, gl.RGBA, gl.UNSIGNED_BYTE, bytes);
            const half = (x) => new Set(bytes.filter((_, k) => Math.floor(k / 480) % 2 === x)).size;
            seen.push([half(0), half(1)]);
        });
    }
    async end() { this.dispatchEvent(new Event("end")); }
}
Object.defineProperty(navigator, "xr", { value: {
    isSessionSupported: async (mode) => mode === "immersive-vr", requestSession: async () => new Session(),
} });
"""


@pytest.fixture
def visit(browser: Any) -> Iterator[Open]:
    """Open an address in a small window; the page has `said`, the lines on its console."""
    contexts = []

    def go(address: str, *, script: str = "") -> Any:
        context = browser.new_context(viewport={"width": 240, "height": 160})
        contexts.append(context)
        page = context.new_page()
        page.set_default_timeout(WAIT)
        page.said = []
        page.on("console", lambda message: page.said.append(f"{message.type}: {message.text}"))
        page.on("pageerror", lambda error: page.said.append(f"error: {error}"))
        if script:
            page.add_init_script(script)
        page.goto(address)
        return page

    yield go
    for context in contexts:
        context.close()


@pytest.fixture(scope="module")
def package(tmp_path_factory: pytest.TempPathFactory) -> Path:
    viewer_files()
    folder = tmp_path_factory.mktemp("shipped") / "scene.gsvis"
    package_of(folder, 800).close()
    return folder


@pytest.fixture(scope="module")
def site(package: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    from gsvis.package import Package

    folder = tmp_path_factory.mktemp("site") / "site"
    with Package.open(package) as opened:
        write_site(folder, opened, viewer=viewer_files())
    return folder


def page_of(url: str) -> str:
    return url.replace("ws", "http", 1).replace("/stream", "") + "/view/scene"


def say(page: Any, text: str) -> None:
    page.wait_for_function("text => document.body.textContent.includes(text)", arg=text)


def explains(page: Any) -> bool:
    """Ask what is in the middle: at first, the view may still be on its way back to where something is."""
    page.keyboard.press("Enter")
    page.wait_for_timeout(300)
    return "cells see it" in page.locator("body").inner_text()


def picture(page: Any) -> np.ndarray:
    """The window once it rests, (H, W, 3) in [0, 1]."""
    last = b""
    while (now := page.screenshot()) != last:
        last = now
        page.wait_for_timeout(100)
    return np.asarray(Image.open(io.BytesIO(now)).convert("RGB"), np.float64) / 255.0


def test_every_key_of_the_help_does_its_work_in_silence(visit: Open, package: Path) -> None:
    with serving(package) as server:
        page = visit(page_of(server.url))
        page.wait_for_function(DRAWN)
        page.keyboard.press("?")
        listed = page.locator(".help section:last-child kbd").all_inner_texts()
        page.keyboard.press("Escape")
        assert {key.lower() for key in listed} <= set(ACTIONS) | {"f"}
        canvas, ways = page.locator("canvas").first, set()
        canvas.focus()
        for _ in range(3):
            page.keyboard.press("m")
            ways.add(page.evaluate("document.documentElement.dataset.mode"))
            page.keyboard.press("w")
        assert ways == {"walk", "fly", "orbit"}
        page.mouse.move(120, 80)
        page.mouse.down()
        page.mouse.move(140, 90)
        page.mouse.up()
        page.mouse.wheel(0, -100)
        for key in (*MOVES, *ACTIONS):
            canvas.focus()
            page.keyboard.press(key)
            page.keyboard.press("Escape")
        page.keyboard.press("x")  # the interface is back
        page.keyboard.press("r")
        page.keyboard.press("i")
        until(lambda: explains(page))
        page.keyboard.press("Escape")
        page.keyboard.press("f")
        page.wait_for_function("() => document.fullscreenElement !== null")
        page.keyboard.press("f")
        page.wait_for_function("() => document.fullscreenElement === null")
        page.wait_for_function(DRAWN)
        assert page.said == []


def test_a_wider_window_is_filled_sharply_and_asks_for_what_it_sees(visit: Open, package: Path) -> None:
    with serving(package) as server:
        narrow, page = (visit(page_of(server.url) + "?noui") for _ in range(2))
        for each in (narrow, page):
            each.wait_for_function("() => document.documentElement.dataset.state === 'complete'")
        page.set_viewport_size({"width": 400, "height": 160})
        until(lambda: server.metrics.opened.value("scene") == 3)  # HELLO with the wider view
        page.wait_for_function(
            "() => (({width, height}) => width === 400 && height === 160)(document.querySelector('canvas'))"
        )
        # As high, so as large, pixel by pixel: the middle of the wide picture is the narrow one.
        until(lambda: bool(np.mean((picture(page)[:, 80:320] - picture(narrow)) ** 2) < 1e-4))
        after = picture(page)
        assert after[:, :80].std() + after[:, 320:].std() > 0.02
        assert page.said == []


def test_after_a_kill_of_the_server_the_page_goes_on_with_what_it_holds(
    visit: Open, package: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    port, log = free_port(), tmp_path / "log"
    command = [sys.executable, "-m", "gsvis", "serve", str(package), "--port", str(port)]
    with log.open("w") as lines:
        running = warm_start.Popen(command, stderr=lines, stdout=subprocess.DEVNULL)
    try:
        until(lambda: running.poll() is not None or " listening " in log.read_text())
        assert running.poll() is None, log.read_text()
        page = visit(f"http://127.0.0.1:{port}/view/scene")
        page.wait_for_function(DRAWN)
    finally:
        running.kill()
        running.wait()
    say(page, "The connection is lost. What has arrived stays")
    with caplog.at_level(logging.INFO, logger="gsvis.serve"), serving(package, port=port):
        say(page, "Connected again.")
        page.wait_for_function(DRAWN)
    (opened,) = [record.getMessage() for record in caplog.records if record.getMessage().startswith("opened ")]
    assert "held=" in opened
    assert not [line for line in page.said if "WebSocket" not in line]  # what the browser itself says


@pytest.mark.parametrize(("kind", "harm"), [("index", "missing"), ("index", "cut"), ("grid", "cut")])
def test_a_part_that_plans_and_is_missing_or_cut_is_named(
    visit: Open, site: Path, kind: str, harm: str, tmp_path: Path
) -> None:
    broken = tmp_path / "site"
    shutil.copytree(site, broken)
    (part,) = (broken / "scene").glob(f"{kind}-*.bin")
    part.unlink() if harm == "missing" else part.write_bytes(part.read_bytes()[: -part.stat().st_size // 3])
    with served(broken) as address:
        page = visit(f"{address}/index.html")
        say(page, part.name)
        assert not [line for line in page.said if "404" not in line and "416" not in line]


@pytest.mark.skipif(NGINX is None or not KINDS.is_file(), reason="needs nginx with its mime.types")
def test_nginx_serves_a_site_by_whole_files(visit: Open, site: Path, tmp_path: Path) -> None:
    port = free_port()
    root = f"include {KINDS}; server {{ listen 127.0.0.1:{port}; root {site}; index index.html; }}"
    with nginx(tmp_path, root, port):
        answers: list[Any] = []
        page = visit("about:blank")
        page.on("response", lambda answer: answers.append(answer))
        page.goto(f"http://127.0.0.1:{port}/")
        page.wait_for_function(DRAWN)
        kinds = {answer.url.split(".")[-1]: answer.headers["content-type"] for answer in answers}
        assert kinds["css"] == "text/css"
        assert kinds["js"].endswith("/javascript")
        assert kinds["bin"] == "application/octet-stream"
        assert not [answer for answer in answers if "range" in answer.request.headers]
        assert {answer.status for answer in answers} == {200}
        assert page.said == []


def test_a_connection_elsewhere_is_not_made_by_an_exported_site(visit: Open, site: Path, package: Path) -> None:
    with serving(package) as server, served(site) as address:
        page = visit(f"{address}/index.html?content={server.url}/scene")
        say(page, "This page may not open that scene")
        assert page.said == []
        page.goto(f"{address}/index.html?content=scene/")
        page.wait_for_function(DRAWN)
        assert server.metrics.refused.value("origin") == 0


def test_a_headset_sees_the_scene_with_both_eyes_until_it_leaves(visit: Open, site: Path) -> None:
    with served(site) as address:
        page = visit(f"{address}/index.html", script=HEADSET)
        page.wait_for_function(DRAWN)
        page.keyboard.press("v")
        page.wait_for_function("() => seen.length > 2 && seen.at(-1).every((colors) => colors > 20)")
        page.keyboard.press("v")
        page.wait_for_function("() => document.querySelector('[data-action=vr]').ariaPressed === 'false'")
        assert page.said == []
