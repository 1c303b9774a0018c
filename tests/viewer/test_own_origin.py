"""A page asks nobody but its own origin, whatever a link says: another server waits beside it and hears nothing."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import quote

import pytest

from gsvis.export import write_html, write_site
from gsvis.scene.procedural import two_rooms
from tests.serve.servers import PATIENCE, serving
from tests.stream.worlds import package_of
from tests.viewer.browser import chromium, page_in, served, viewer_files

pytestmark = pytest.mark.slow
SMALL: dict[str, Any] = {"viewport": {"width": 240, "height": 160}}
SAID = "text => document.body.innerText.includes(text)"
DRAWN = "() => document.documentElement.dataset.state === 'complete'"
TOKEN = "secret-of-this-page"
SPELLINGS = (
    "ws://OTHER/stream", "http://OTHER/s/", "//OTHER/s/", "\\\\OTHER/s/", "/\\OTHER/s/", "http:\\\\OTHER/s/",
    "ws://SELF@OTHER/stream", "\tws://OTHER/stream",
)  # fmt: skip


@pytest.fixture(scope="module")
def package(tmp_path_factory: pytest.TempPathFactory) -> Path:
    viewer_files(), chromium()
    folder = tmp_path_factory.mktemp("own") / "scene.gsvis"
    package_of(folder, 800, stores=False).close()
    return folder


@contextmanager
def listener(redirect: str = "") -> Iterator[tuple[str, list[str]]]:
    """A server that writes down what it is asked; gives its host and port, and the requests."""
    heard: list[str] = []

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            heard.append(f"{self.path} {self.headers}")
            self.send_response(302 if redirect else 404)
            self.send_header("access-control-allow-origin", "*")
            self.send_header("content-length", "0")
            if redirect:
                self.send_header("location", redirect)
            self.end_headers()

        def log_message(self, format: str, *args: object) -> None:
            pass

    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"127.0.0.1:{server.server_address[1]}", heard
        server.shutdown()


def links(page: str, other: str) -> Iterator[str]:
    own = page.split("/")[2]
    for spelling in SPELLINGS:
        text = quote(spelling.replace("OTHER", other).replace("SELF", own), safe="")
        yield f"{page}?content={text}#content={text}&settings={text}"


def test_a_served_page_opens_no_other_origin_and_keeps_its_token(browser: Any, package: Path) -> None:
    with serving(package, token=TOKEN) as server, listener() as (other, heard):
        page_at = server.url.replace("ws", "http", 1).replace("/stream", "") + "/view/scene"
        with page_in(browser, f"{page_at}?token={TOKEN}", **SMALL) as (page, _):
            page.wait_for_function(DRAWN, timeout=1000 * PATIENCE)
            for link in links(page_at, other):
                page.goto(link)
                page.wait_for_function(SAID, arg="This page may not open that scene", timeout=1000 * PATIENCE)
            settings = quote(f"http://{other}/settings.json", safe="")
            page.goto(f"{page_at}?settings={settings}&token={TOKEN}")
            page.wait_for_function(DRAWN, timeout=1000 * PATIENCE)
    assert heard == []


def test_the_policy_holds_in_workers_of_a_served_page_too(browser: Any, package: Path) -> None:
    """Code that ran in a Worker, such as by a fault of ours, could not send anything elsewhere either."""
    with serving(package) as server, listener() as (other, heard):
        root = server.url.replace("ws", "http", 1).replace("/stream", "")
        with page_in(browser, f"{root}/view/scene", **SMALL, service_workers="block") as (page, _):
            page.wait_for_function(DRAWN, timeout=1000 * PATIENCE)
            workers = [worker for worker in page.workers if "/viewer/" in worker.url]
            assert {worker.url.rpartition("/")[2] for worker in workers} == {"network.js", "sort.js"}
            for worker in workers:
                refused = f"fetch('http://{other}/', {{mode: 'no-cors'}}).then(() => 'sent', () => 'refused')"
                assert worker.evaluate(refused) == "refused"
                blocked = f"""new Promise((say) => {{
                    try {{ const s = new WebSocket('ws://{other}/'); s.onopen = () => say('sent');
                    s.onerror = () => say('refused'); }} catch {{ say('refused'); }} }})"""
                assert worker.evaluate(blocked) == "refused"
    assert heard == []


def test_a_site_and_a_page_in_one_file_open_no_other_origin(browser: Any, tmp_path: Path) -> None:
    scene, files = two_rooms(1000, sh_degree=0).gaussians, viewer_files()
    write_site(tmp_path / "site", scene, viewer=files)
    write_html(tmp_path / "site" / "one.html", scene, viewer=files)
    with served(tmp_path / "site") as address, listener() as (other, heard):
        for name in ("index.html", "one.html"):
            with page_in(browser, f"{address}/{name}", **SMALL) as (page, _):
                page.wait_for_function(DRAWN, timeout=1000 * PATIENCE)
                for link in links(f"{address}/{name}", other):
                    page.goto(link)
                    page.wait_for_function(SAID, arg="This page may not open that scene", timeout=1000 * PATIENCE)
    assert heard == []


def test_a_redirect_of_the_own_origin_does_not_lead_elsewhere(browser: Any, tmp_path: Path) -> None:
    write_site(tmp_path, two_rooms(1000, sh_degree=0).gaussians, viewer=viewer_files())
    with listener() as (other, heard), listener(f"http://{other}/scene.json") as (own, asked):
        with page_in(browser, "about:blank", **SMALL) as (page, _):
            page.route("**/*", lambda route: _answer(route, tmp_path))
            page.goto(f"http://{own}/index.html?content=/away/")
            page.wait_for_function(SAID, arg="The scene cannot be loaded", timeout=1000 * PATIENCE)
        assert any("/away/scene.json" in line for line in asked)
    assert heard == []


def _answer(route: Any, folder: Path) -> None:
    name = route.request.url.split("?")[0].split("/", 3)[3]
    file = folder / name
    route.fulfill(path=file) if file.is_file() else route.continue_()


def test_who_writes_the_page_names_other_origins_and_they_get_no_token(
    browser: Any, package: Path, tmp_path: Path
) -> None:
    write_site(tmp_path, two_rooms(1000, sh_degree=0).gaussians, viewer=viewer_files())
    # `elsewhere` lacks the header that another origin needs to read it: the test is about what it is asked.
    with served(tmp_path / "scene") as elsewhere, serving(package, opens=(elsewhere,), token=TOKEN) as server:
        page_at = server.url.replace("ws", "http", 1).replace("/stream", "") + "/view/scene"
        with page_in(browser, "about:blank", **SMALL) as (page, _):
            with page.expect_request(lambda request: request.url.startswith(elsewhere)) as asked:
                page.goto(f"{page_at}?token={TOKEN}&content={elsewhere}/")
            assert TOKEN not in f"{asked.value.url} {asked.value.all_headers()}"
