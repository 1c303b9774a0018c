"""Authoring in the page: views, hotspots, background and path by mouse and keys, kept as a draft and downloaded."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from tests.viewer.browser import page_in
from tests.viewer.page_server import AXE, HOSTILE, OUTSIDE, VIEWER

pytestmark = pytest.mark.slow
CHROMIUM = ("--disable-gpu",)  # nothing here draws with WebGL, and software in its place costs most of a test
FIRST = ["View 1", "Window", HOSTILE]
ROOM = "/view/show%20room?settings=settings.json&author"


def names(page: Any) -> list[str]:
    """Return the names of the views in the panel."""
    found: list[str] = page.locator(".rows > li:not(.spot-edit) input").evaluate_all("all => all.map((x) => x.value)")
    return found


def download(page: Any, folder: Path) -> Any:
    """Return the settings that the panel gives."""
    with page.expect_download() as waiting:
        page.get_by_role("button", name="Download settings.json").click()
    waiting.value.save_as(folder / "settings.json")
    return json.loads((folder / "settings.json").read_text())


def test_what_an_author_makes_is_kept_downloaded_and_shown(browser: Any, address: str, tmp_path: Path) -> None:
    with page_in(browser, address + ROOM) as (page, said):
        page.get_by_role("button", name="Add this view").click()
        assert names(page) == [*FIRST, "View 4"]
        page.get_by_label("Name of View 4").fill("Door")
        page.get_by_label("Name of View 4").press("Enter")
        page.get_by_label("Place by clicking the scene").click()
        page.mouse.click(300, 500)
        page.get_by_label("Title of Place 1").fill("Lamp")
        page.get_by_label("Link of Place 1").fill("https://example.org/lamp")
        page.get_by_role("button", name="Move Door up").press("Enter")
        assert names(page) == [*FIRST[:2], "Door", HOSTILE]
        page.get_by_role("button", name="Make a path through the views").click()
        page.get_by_label("Play at the start").click()
        made = download(page, tmp_path)
        assert [camera.get("name") for camera in made["cameras"]] == [None, "Window", "Door", HOSTILE]
        assert made["annotations"][-1]["title"] == "Lamp"
        assert made["annotations"][-1]["position"] == [-3.4, -1.2, 1.1]  # turned, as SuperSplat has it
        assert made["annotations"][-1]["extras"] == {"link": "https://example.org/lamp"}
        assert (len(made["animTracks"]), made["startMode"]) == (1, "animTrack")
        page.reload()
        page.get_by_role("button", name="Delete Door").wait_for()
        assert download(page, tmp_path) == made
        page.get_by_role("button", name="Delete Door").click()
        page.get_by_role("button", name="Undo").click()
        assert names(page) == [*FIRST[:2], "Door", HOSTILE]
        page.get_by_role("button", name="Discard the draft").click()
        assert names(page) == FIRST
        page.reload()
        page.get_by_role("button", name="Add this view").wait_for()
        assert names(page) == FIRST
        assert said == []
    opened = browser.new_context()
    page = opened.new_page()
    page.route("**/settings.json", lambda route: route.fulfill(json=made))
    page.goto(f"{address}/view/show%20room?settings=settings.json&noanim")
    page.get_by_role("button", name="Play the animation").wait_for()
    page.get_by_role("button", name="Next view").click()
    page.get_by_role("button", name="Next view").click()
    page.get_by_text("Door", exact=True).wait_for()
    opened.close()


@pytest.mark.parametrize(("locale", "width"), [("en", 1280), ("de-DE", 375)])
def test_the_panel_has_nothing_for_axe_and_keeps_the_focus(browser: Any, address: str, locale: str, width: int) -> None:
    axe = VIEWER / "node_modules" / "axe-core" / "axe.min.js"
    if not axe.exists():
        pytest.skip("no axe-core: run npm ci in viewer/")
    size = {"width": width, "height": 700}
    with page_in(browser, address + ROOM, locale=locale, viewport=size, bypass_csp=True) as (page, said):
        page.locator("[data-at=add]").press("Enter")
        assert page.evaluate("document.activeElement.dataset.at") == "add"
        page.locator("[data-at=middle]").press("Enter")
        page.locator(".spot-edit").wait_for()
        page.locator("[data-at=path]").press("Enter")
        page.locator("[data-at=unpath]").wait_for()
        page.locator("[data-at=drop-3]").press("Enter")
        assert page.evaluate("document.activeElement.dataset.at") == "add"
        page.evaluate(axe.read_text())
        assert page.evaluate(AXE) == []
        assert page.evaluate(OUTSIDE) == []
        assert said == []
