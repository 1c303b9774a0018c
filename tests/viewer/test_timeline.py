"""The timeline of camera paths in a real browser: by keys, mouse and touch, for visitors, and without controls."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from typing import Any

import pytest

from tests.viewer.browser import page_in
from tests.viewer.gestures import eye, motion_of_tour
from tests.viewer.page_server import TOUR

pytestmark = pytest.mark.slow
CHROMIUM = ("--disable-gpu",)  # nothing here draws with WebGL, and software in its place costs most of a test
Open = Callable[..., Any]


@pytest.fixture
def visit(browser: Any, address: str) -> Iterator[Open]:
    """Open the page with a query, and with documents in place of files; at the end nothing may stand on the console."""
    with ExitStack() as opened:
        consoles: list[list[str]] = []

        def go(query: str, settings: Any = None, **options: Any) -> Any:
            page, said = opened.enter_context(page_in(browser, "about:blank", **options))
            consoles.append(said)
            if settings is not None:
                page.route("**/once.json", lambda route: route.fulfill(json=settings))
            page.goto(f"{address}/view/show%20room?{query}")
            page.wait_for_function("() => location.hash.length > 1")  # the first view is there
            return page

        yield go
        assert [line for said in consoles for line in said] == []


def test_a_timeline_seeks_by_keys_mouse_and_touch_and_plays_on(visit: Open) -> None:
    page = visit("settings=tour.json&noanim")
    slider = page.get_by_role("slider", name="Position in the animation")
    assert slider.get_attribute("aria-valuetext") == "0 of 8 seconds"
    slider.press("ArrowRight")
    slider.press("ArrowRight")
    assert slider.get_attribute("aria-valuetext") == "2 of 8 seconds"
    assert eye(page) == pytest.approx([5, 1, 1.6], abs=1e-6)  # its second key, at once
    slider.press("PageUp")
    assert float(slider.input_value()) == pytest.approx(2.8)
    slider.press("Home")
    assert eye(page) == pytest.approx([1, 1, 1.6], abs=1e-6)
    box = slider.bounding_box()
    page.mouse.click(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    assert float(slider.input_value()) == pytest.approx(4, abs=0.1)
    assert page.get_by_text("0:04 / 0:08").or_(page.get_by_text("0:03 / 0:08")).is_visible()
    assert page.get_by_role("img", name="Begins again at its end").is_visible()
    play = page.locator("[data-action=play]")
    assert play.get_attribute("aria-pressed") == "false"
    slider.press("Space")
    with motion_of_tour(page):
        assert play.get_attribute("aria-pressed") == "true"
    page.mouse.move(box["x"] + 4, box["y"] + box["height"] / 2)
    page.mouse.down()
    page.wait_for_selector("[data-action=play][aria-pressed=false]")  # held: it waits
    page.mouse.up()
    page.wait_for_selector("[data-action=play][aria-pressed=true]")
    page.locator("canvas").first.focus()
    page.keyboard.press("Space")
    page.wait_for_selector("[data-action=play][aria-pressed=false]")


def test_a_path_without_an_end_of_its_own_rests_at_its_last_picture_and_begins_again(visit: Open) -> None:
    once: dict[str, Any] = copy.deepcopy(TOUR)
    once["animTracks"][0] |= {"loopMode": "none", "duration": 6}
    page = visit("settings=once.json", once)
    slider = page.get_by_role("slider", name="Position in the animation")
    slider.press("End")
    page.wait_for_selector("[data-action=play][aria-pressed=false]")
    assert slider.get_attribute("aria-valuetext") == "6 of 6 seconds"
    assert eye(page) == pytest.approx([1, 3, 1.6], abs=1e-6)
    page.locator("[data-action=play]").click()
    with motion_of_tour(page):
        assert float(slider.input_value()) < 6


def test_visitors_lose_the_timeline_while_it_plays_and_get_it_back(visit: Open) -> None:
    page = visit("settings=tour.json&visitor", viewport={"width": 375, "height": 667}, has_touch=True, is_mobile=True)
    bar = page.locator(".timeline")
    bar.wait_for(state="hidden")
    page.touchscreen.tap(200, 300)
    bar.wait_for(state="visible")
    page.wait_for_selector("[data-action=play][aria-pressed=true]")  # a tap alone moves nothing
    bare = visit("settings=tour.json&noui")
    bare.locator(".timeline").wait_for(state="attached")
    assert not bare.locator(".timeline").is_visible()
