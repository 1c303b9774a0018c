"""What a visitor sees when something is wrong: the built page in Chromium, and servers that fail.

The page says what has happened, and goes on when it can.
"""

from __future__ import annotations

import struct
import threading
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest
from websockets.sync.server import ServerConnection, serve

from gsvis.export import StaticOptions, write_site
from gsvis.scene.procedural import two_rooms
from gsvis.stream.wire import ServerFault
from tests.serve.servers import PATIENCE, serving
from tests.stream.worlds import package_of
from tests.viewer.browser import chromium, page_in, served, viewer_files

pytestmark = pytest.mark.slow
SMALL: dict[str, Any] = {"viewport": {"width": 240, "height": 160}}
HOSTILE = "<img src=x onerror=alert(1)>"
DRAWN = """() => document.documentElement.dataset.state === 'complete'
    && /[1-9]/.test(document.querySelector('.state').textContent)"""


@pytest.fixture(scope="module")
def package(tmp_path_factory: pytest.TempPathFactory) -> Path:
    viewer_files(), chromium()
    folder = tmp_path_factory.mktemp("bad") / "scene.gsvis"
    package_of(folder, 800, stores=False).close()
    return folder


@pytest.fixture(scope="module")
def site(package: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A site of a bare scene."""
    folder = tmp_path_factory.mktemp("site")
    write_site(folder, two_rooms(2000, sh_degree=1).gaussians, StaticOptions(name=HOSTILE), viewer=viewer_files())
    return folder


def say(page: Any, text: str) -> None:
    """Wait until the page shows a text."""
    page.wait_for_function("text => document.body.innerText.includes(text)", arg=text, timeout=1000 * PATIENCE)


def wait(page: Any, fact: str) -> None:
    page.wait_for_function(fact, timeout=1000 * PATIENCE)


def page_of(url: str, name: str = "scene") -> str:
    return url.replace("ws", "http", 1).replace("/stream", "") + f"/view/{name}"


def origin_of(stream: str) -> str:
    return "/".join(stream.split("/")[:3]).replace("ws", "http", 1)


@contextmanager
def talker(answer: Callable[[ServerConnection], None]) -> Iterator[str]:
    """A stream that says to each client what it likes."""
    with serve(answer, "127.0.0.1", 0, compression=None) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"ws://127.0.0.1:{server.socket.getsockname()[1]}/stream/scene"
        server.shutdown()


def test_a_server_that_comes_back_after_minutes_goes_on(browser: Any, package: Path) -> None:
    with serving(package) as server:
        address = page_of(server.url)
        port = int(server.url.split(":")[2].split("/")[0])
        with page_in(browser, address, **SMALL) as (page, _):
            wait(page, DRAWN)
            page.clock.install()
            server.stop()
            say(page, "The connection is lost. What has arrived stays")
            say(page, "Retrying")
            page.clock.fast_forward(600_000)  # ten minutes: it still asks, and shows what it has
            say(page, "Retrying")
            with serving(package, port=port):
                wait(page, DRAWN)
                say(page, "Connected again.")


def test_another_version_of_the_wire_is_said_and_a_later_try_can_help(browser: Any, package: Path) -> None:
    def old(client: ServerConnection) -> None:
        client.recv(timeout=PATIENCE)
        client.send(ServerFault(2, "this server speaks version 9").to_bytes())
        client.close(1002)

    with talker(old) as stream, serving(package, opens=(origin_of(stream),)) as server:
        address = f"{page_of(server.url)}?content={stream}"
        with page_in(browser, address, **SMALL) as (page, _):
            say(page, "Viewer and server differ in version")
            assert "version 9" in page.locator(".card code").text_content()
            assert page.get_by_role("button", name="Try again").is_visible()


def test_noise_instead_of_a_stream_is_given_up_in_words(browser: Any, package: Path) -> None:
    def noisy(client: ServerConnection) -> None:
        client.recv(timeout=PATIENCE)
        client.send(struct.pack("<BI", 77, 5))

    with talker(noisy) as stream, serving(package, opens=(origin_of(stream),)) as server:
        address = f"{page_of(server.url)}?content={stream}"
        with page_in(browser, address, **SMALL) as (page, _):
            say(page, "Viewer and server do not understand each other.")
            assert "does not understand" in page.locator(".card code").text_content()
            assert page.inner_text(".toast") == ""  # nothing is connected again


def test_a_token_that_no_longer_counts_can_be_entered_anew(browser: Any, package: Path) -> None:
    with serving(package, token="earlier") as server:
        address = page_of(server.url)
        port = int(server.url.split(":")[2].split("/")[0])
        with page_in(browser, f"{address}?token=earlier", **SMALL) as (page, _):
            wait(page, DRAWN)
            assert "token" not in page.url
            server.stop()
            say(page, "The connection is lost")
            with serving(package, port=port, token="later"):
                say(page, "The server did not let this page in")
                page.get_by_label("Token").fill("later")
                page.keyboard.press("Enter")
                wait(page, DRAWN)
                assert page.locator(".card").is_hidden()
                assert "later" not in page.url


def test_without_webgl2_the_page_says_what_is_needed(browser: Any, package: Path) -> None:
    blind = browser.browser_type.launch(executable_path=chromium(), args=["--disable-gpu", "--disable-3d-apis"])
    with closing(blind), serving(package) as server, page_in(blind, page_of(server.url), **SMALL) as (page, _):
        say(page, "This browser cannot draw the scene")
        assert page.inner_text(".state") == "Stopped"


def test_a_lost_picture_is_drawn_again(browser: Any, package: Path) -> None:
    with serving(package) as server, page_in(browser, page_of(server.url), **SMALL) as (page, said):
        wait(page, DRAWN)
        page.evaluate("""() => {
            const gl = document.querySelector('canvas').getContext('webgl2');
            window.lose = gl.getExtension('WEBGL_lose_context');
            lose.loseContext();
        }""")
        say(page, "The graphics card has taken the picture back")
        page.evaluate("lose.restoreContext()")
        wait(page, "() => document.querySelector('.toast').textContent === ''")
        page.keyboard.press("t")
        wait(page, "() => /[1-9]/.test(document.querySelector('[data-figure=drawn]').textContent)")
        assert [line for line in said if line.startswith("error")] == []


@pytest.mark.parametrize("harm", ["missing", "cut"])
def test_a_part_that_is_gone_or_cut_is_named_and_the_rest_is_drawn(browser: Any, harm: str, tmp_path: Path) -> None:
    viewer, _ = viewer_files(), chromium()
    with package_of(tmp_path / "s.gsvis", 800) as package:
        made = write_site(tmp_path / "site", package, viewer=viewer)
    part = made.scene.path / made.scene.files["terms"].names[0]
    if harm == "missing":
        part.unlink()
    else:
        part.write_bytes(part.read_bytes()[:-9])
    with ranges(tmp_path / "site") as address, page_in(browser, f"{address}/index.html", **SMALL) as (page, _):
        say(page, part.name)
        wait(page, DRAWN)
        assert page.locator(".card").is_hidden()
        assert "All that can be seen" not in page.inner_text("body")


def test_a_view_out_of_sight_says_so_and_leads_back(browser: Any, site: Path) -> None:
    with served(site) as address:
        away = f"{address}/index.html#eye=9000,9000,9000&to=9999,9999,9999&fov=20"
        with page_in(browser, away, **SMALL) as (page, _):
            say(page, "Nothing of the scene can be seen from here.")
            page.keyboard.press("r")
            page.keyboard.press("t")
            wait(page, "() => /[1-9]/.test(document.querySelector('[data-figure=drawn]').textContent)")


@pytest.mark.parametrize(("file", "kind"), [("page.js", "text/javascript"), ("page.css", "text/css")])
def test_a_file_of_the_page_that_a_host_sends_as_text_is_named(browser: Any, file: str, kind: str, site: Path) -> None:
    with served(site) as address, closing(browser.new_context(**SMALL)) as opened:
        page = opened.new_page()
        page.route(
            f"**/viewer/{file}", lambda route: route.fulfill(path=site / "viewer" / file, content_type="text/plain")
        )
        page.goto(f"{address}/index.html")
        say(page, f"viewer/{file} did not load: the host has to have it, and to send it as {kind}.")


def test_a_name_with_markup_is_text_everywhere(browser: Any, site: Path) -> None:
    with served(site) as address, page_in(browser, f"{address}/index.html", **SMALL) as (page, said):
        wait(page, DRAWN)
        assert page.inner_text("h1") == HOSTILE
        assert page.title() == f"{HOSTILE} · gsvis"
        assert page.locator("img").count() == 0
        assert said == []


@contextmanager
def ranges(folder: Path) -> Iterator[str]:
    """A file server that answers ranges, as those of most sites do."""

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            path = folder / self.path.partition("?")[0].lstrip("/")
            if not path.is_file():
                self.send_error(404)
                return
            data, status = path.read_bytes(), 200
            kinds = {".js": "text/javascript", ".css": "text/css", ".html": "text/html", ".json": "application/json"}
            headers = {"content-type": kinds.get(path.suffix, "application/octet-stream")}
            if asked := self.headers.get("range"):
                first, last = (int(word) for word in asked.removeprefix("bytes=").split("-"))
                headers["content-range"] = f"bytes {first}-{min(last, len(data) - 1)}/{len(data)}"
                data, status = data[first : last + 1], 206
            self.send_response(status if data else 416)
            for name, value in (headers | {"content-length": str(len(data))}).items():
                self.send_header(name, value)
            self.end_headers()
            self.wfile.write(data)

        def log_message(self, format: str, *args: object) -> None:
            pass

    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_address[1]}"
        server.shutdown()
