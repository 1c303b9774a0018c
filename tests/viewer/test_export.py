"""What `gsvis export` writes, in Chromium: a site from a plain file server, and one file from disk."""

from __future__ import annotations

import json
from base64 import b64encode
from pathlib import Path
from typing import Any
from urllib.parse import quote

import pytest

from gsvis.export import StaticOptions, write_html, write_site
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.procedural import two_rooms
from tests.serve.servers import PATIENCE
from tests.stream.worlds import package_of
from tests.viewer.browser import page_in, served, viewer_files

ARRIVED = "All that can be seen from here has arrived."


@pytest.fixture(scope="module")
def scene() -> Gaussians:
    return two_rooms(4000, sh_degree=1).gaussians


def wait_for(page: Any, text: str) -> None:
    page.wait_for_function("text => document.body.textContent.includes(text)", arg=text, timeout=1000 * PATIENCE)


def test_a_site_shows_its_scene_from_a_server_without_ranges(browser: Any, scene: Gaussians, tmp_path: Path) -> None:
    viewer = viewer_files()
    write_site(tmp_path, scene, StaticOptions(name="Two <b>rooms</b>"), viewer=viewer)
    with served(tmp_path) as address, page_in(browser, address + "/index.html") as (page, said):
        wait_for(page, ARRIVED)
        assert page.title() == "Two <b>rooms</b> · gsvis"
        assert said == []


def test_a_package_as_a_site_names_what_is_missing_and_shows_the_rest(browser: Any, tmp_path: Path) -> None:
    viewer = viewer_files()
    with package_of(tmp_path / "s.gsvis", 400) as package:
        made = write_site(tmp_path / "site", package, viewer=viewer)
    missing = made.scene.files["terms"].names[0]
    (made.scene.path / missing).unlink()
    with served(tmp_path / "site") as address, page_in(browser, address + "/index.html") as (page, said):
        wait_for(page, missing)
        assert ARRIVED not in page.inner_text("body")
        assert all("404" in each for each in said)  # what the browser itself says of a missing file


TOUR = {
    "version": 2, "frame": "scene", "cameras": [{"initial": {"position": [1, 1, 1], "target": [2, 1, 1]}}],
    "animTracks": [{
        "name": "way", "duration": 3600, "frameRate": 1, "loopMode": "none", "interpolation": "spline",
        "keyframes": {"times": [0, 3600], "values": {"position": [1, 1, 1, 3, 1, 1], "target": [9, 1, 1, 9, 1, 1]}},
    }],
}  # fmt: skip


def test_one_file_plays_an_animation(browser: Any, scene: Gaussians, tmp_path: Path) -> None:
    viewer = viewer_files()
    write_html(tmp_path / "rooms.html", scene, viewer=viewer)
    settings = "data:application/json;base64," + b64encode(json.dumps(TOUR).encode()).decode()
    address = f"{(tmp_path / 'rooms.html').as_uri()}?settings={quote(settings, safe='')}"
    with page_in(browser, address) as (page, said):
        wait_for(page, ARRIVED)
        patience = {"state": "attached", "timeout": 1000 * PATIENCE}
        page.wait_for_selector("[data-action=play]:not([hidden])", **patience)
        for playing in ("true", "false"):
            page.keyboard.press("k")
            page.wait_for_selector(f"[data-action=play][aria-pressed={playing}]", **patience)
        assert said == []


def test_a_site_of_a_package_knows_its_cells_and_floor_without_a_server(browser: Any, tmp_path: Path) -> None:
    viewer = viewer_files()
    with package_of(tmp_path / "s.gsvis", 400) as package:
        write_site(tmp_path / "site", package, viewer=viewer)
        write_html(tmp_path / "scene.html", package, viewer=viewer)
    with served(tmp_path / "site") as address:
        for where in (address + "/index.html", (tmp_path / "scene.html").as_uri()):
            with page_in(browser, where) as (page, said):
                wait_for(page, ARRIVED)
                assert "missing" not in page.inner_text("body")  # all files are there and can be read
                page.keyboard.press("b")
                page.wait_for_selector("canvas.overlay:not([hidden])", state="attached", timeout=1000 * PATIENCE)
                page.keyboard.press("o")
                wait_for(page, "Only a server knows")
                assert "Visibility" not in page.inner_text(".panel")
                assert said == []


def test_a_site_fetches_its_walls_when_somebody_walks_one_file_holds_them(browser: Any, tmp_path: Path) -> None:
    viewer = viewer_files()
    rooms = two_rooms(4000, sh_degree=0)
    options = StaticOptions(space=rooms.navigable)
    made = write_site(tmp_path / "site", rooms.gaussians, options, viewer=viewer)
    write_html(tmp_path / "rooms.html", rooms.gaussians, options, viewer=viewer)
    (walls,) = made.scene.files["walk"].names
    with served(tmp_path / "site") as address, page_in(browser, address + "/index.html") as (page, said):
        asked: list[str] = []
        page.on("request", lambda request: asked.append(request.url))
        wait_for(page, ARRIVED)
        assert not [url for url in asked if walls in url]
        with page.expect_response(lambda response: walls in response.url, timeout=1000 * PATIENCE):
            page.get_by_text("Walk", exact=True).click()
        assert said == []
    held = (tmp_path / "rooms.html").read_text(encoding="utf-8")
    assert f'data-name="{walls}"' in held


def test_one_file_opens_from_disk(browser: Any, scene: Gaussians, tmp_path: Path) -> None:
    viewer = viewer_files()
    write_html(tmp_path / "rooms.html", scene, viewer=viewer)
    asked: list[str] = []
    with page_in(browser, (tmp_path / "rooms.html").as_uri()) as (page, said):
        page.on("request", lambda request: asked.append(request.url))
        wait_for(page, ARRIVED)
        page.get_by_text("Walk", exact=True).click()
        wait_for(page, "Nothing is known of walls here.")
        assert said == []
    assert [url for url in asked if not url.startswith(("blob:", "data:"))] == []
