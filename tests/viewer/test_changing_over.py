"""The page of a large scene: it waits for a sample that is still written, and keeps its picture until all is there."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from gsvis.export import StaticOptions, write_static
from gsvis.export.start import start_poses
from gsvis.scene.procedural import two_rooms
from gsvis.serve import Address, Scenes, Server
from gsvis.serve.scenes import open_scene, promise_scene
from tests.serve.servers import PATIENCE

pytestmark = pytest.mark.slow
UP = (0.0, 0.0, 1.0)
STATE = "(kind) => document.documentElement.dataset.state === kind"
DRAWN = "() => /[0-9]/.test(document.querySelector('[data-figure=first]').textContent)"
SHOWS = "(words) => document.querySelector('.state')?.textContent === words"


@pytest.fixture
def page(browser: Any) -> Iterator[Any]:
    context = browser.new_context(viewport={"width": 240, "height": 160})
    opened = context.new_page()
    opened.set_default_timeout(1000 * PATIENCE)
    yield opened
    context.close()


@pytest.mark.parametrize("moves", [False, True])
def test_the_picture_of_a_sample_stays_until_all_is_there_or_somebody_moves(
    page: Any, tmp_path: Path, moves: bool
) -> None:
    g = two_rooms(3000).gaussians
    options = StaticOptions("hall", UP, poses=start_poses(g.bounds(0.9), None, UP), is_near=True)
    sample = promise_scene(tmp_path / "some", "hall", 500)
    sample.preparing = True
    with Scenes([sample]) as scenes:
        server = Server(scenes, None, Address(port=0))
        with server.running():
            page.goto(server.page("hall"))
            page.wait_for_function(STATE, arg="connecting")
            write_static(tmp_path / "some", g[:500], options)
            assert sample.site is not None
            sample.site.read()
            page.wait_for_function(SHOWS, arg="500 Gaussians")
            page.keyboard.press("t")
            page.wait_for_function(DRAWN)
            before = page.evaluate("location.hash")
            held: list[Any] = []
            free: list[bool] = []
            page.route("**/plain-*", lambda route: route.continue_() if free else held.append(route))
            write_static(tmp_path / "all", g, options)
            scenes.replace(open_scene(tmp_path / "all", "hall"))
            page.wait_for_selector("canvas.poster")
            page.wait_for_function(STATE, arg="streaming")
            assert page.locator("canvas:not(.overlay)").count() == 2
            if moves:
                page.keyboard.down("ArrowLeft")
                page.wait_for_selector("canvas.poster", state="detached")
                page.keyboard.up("ArrowLeft")
            else:
                assert page.evaluate("location.hash") == before
            free.append(True)
            for route in held:
                route.continue_()
            page.wait_for_function(SHOWS, arg=f"{len(g) / 1000:g} k Gaussians")
            page.wait_for_selector("canvas.poster", state="detached")
