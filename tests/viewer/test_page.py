"""The page of a scene in a real browser, with a stand-in for the core: every control by mouse, touch and keys.

Needs Chromium, playwright, node and the packages of viewer/; skips with a reason without one of them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.serve.servers import PATIENCE
from tests.viewer.gestures import HASTE, drag, eye, hold, mode, motion, motion_of_tour, rest
from tests.viewer.page_server import AXE, HOSTILE, OUTSIDE, VIEWER

pytestmark = pytest.mark.slow
CHROMIUM = ("--disable-gpu",)  # nothing here draws with WebGL, and software in its place costs most of a test
SIZES = {"wide": (1280, 800), "tablet": (768, 1024), "phone": (375, 667)}
WAIT = 1000 * PATIENCE  # milliseconds; a guard against hanging
ROOM = "/view/show%20room"
Open = Callable[..., Any]
READY = """() => document.documentElement.dataset.state === 'streaming' && location.hash.length > 1
    && fake.camera.position.some((x) => x !== 0)"""  # an address may come with its hash: the view is set a frame later


@pytest.fixture
def visit(browser: Any, address: str) -> Iterator[Open]:
    """Open a path of the server; at the end nothing may stand on the console."""
    contexts, said = [], []

    def go(path: str = ROOM, *, size: str = "wide", ready: bool = True, **options: Any) -> Any:
        width, height = SIZES[size]
        context = browser.new_context(viewport={"width": width, "height": height}, **options)
        contexts.append(context)
        context.add_init_script(HASTE)
        page = context.new_page()
        page.set_default_timeout(WAIT)
        page.on("console", lambda message: said.append(f"{message.type}: {message.text}"))
        page.on("pageerror", lambda error: said.append(f"error: {error}"))
        page.goto(address + path)
        if ready:
            page.wait_for_function(READY)
        return page

    yield go
    for context in contexts:
        context.close()
    assert said == []


def test_a_visit_begins_on_the_floor_of_the_room_in_walk(visit: Open) -> None:
    page = visit()
    assert mode(page) == "walk"
    x, y, z = eye(page)
    assert 0 < x < 6
    assert 0 < y < 4
    assert abs(z - 1.6) < 1e-3
    assert page.title() == "show room · gsvis"


@pytest.mark.parametrize("way", ["orbit", "fly", "walk"])
def test_mouse_turns_pans_and_zooms_in_every_way_to_move(visit: Open, way: str) -> None:
    page = visit()
    page.get_by_text(way.capitalize(), exact=True).click()
    assert mode(page) == way
    rest(page)
    with motion(page):
        drag(page, 120, 40)
    with motion(page, eye):
        drag(page, 80, 60, button="right")
    with motion(page, eye):
        page.mouse.wheel(0, -300)


@pytest.mark.parametrize("way", ["orbit", "fly", "walk"])
def test_keys_turn_and_move_in_every_way_to_move(visit: Open, way: str) -> None:
    page = visit(f"{ROOM}#eye=2.5,1.5,1.6&to=4,2.5,1&mode={way}")
    page.locator("canvas").first.focus()
    for key in ("ArrowLeft", "ArrowRight"):
        hold(page, key)
    for key in ("w", "a", "s", "d", *("qe" if way != "walk" else "")):
        hold(page, key, eye)
    if way != "walk":  # a wall may be ahead
        with motion(page, eye):
            page.keyboard.press("+")


def test_walking_stays_on_the_floor(visit: Open) -> None:
    page = visit(f"{ROOM}#eye=1.5,0.5,1.6&to=9,0.5,1.2&mode=walk")
    page.locator("canvas").first.focus()
    page.keyboard.down("Shift")
    page.keyboard.down("KeyW")
    page.wait_for_function("() => fake.camera.position[0] > 5.5")
    rest(page)  # at the wall
    page.keyboard.up("KeyW")
    page.keyboard.up("Shift")
    rest(page)
    x, y, z = eye(page)
    assert 5.5 < x <= 6.0
    assert 0 <= y <= 4
    assert abs(z - 1.6) < 1e-3


def test_a_reconnect_leaves_the_options_as_they_are_another_scene_fills_them_anew(visit: Open) -> None:
    page = visit()
    page.keyboard.press("o")
    page.evaluate("window.kept = [...document.querySelectorAll('.panel > section, .panel > .actions')], fake.greet()")
    rest(page)
    assert page.evaluate("kept.length > 3 && kept.every((each) => each.isConnected)")
    page.evaluate("fake.greet('1'.repeat(64))")
    page.wait_for_function("() => !kept[0].isConnected")
    assert page.evaluate("kept.at(-1).isConnected")  # its buttons watch the actions, and are made once


def test_letters_move_when_a_button_has_the_focus_and_not_when_somebody_types(visit: Open) -> None:
    page = visit()
    page.get_by_role("button", name="Options").focus()
    hold(page, "w", eye)
    page.evaluate("fake.become({kind: 'failed', message: 'no', code: 4})")
    before = eye(page)
    page.get_by_label("Token").press_sequentially("wasd?h")
    rest(page)
    assert eye(page) == before
    assert page.get_by_role("dialog").count() == 0


def test_fingers_turn_pan_and_pinch(visit: Open) -> None:
    page = visit(f"{ROOM}#eye=1,1,1.6&to=4,2,1&mode=orbit", size="phone", has_touch=True, is_mobile=True)
    client = page.context.new_cdp_session(page)

    def touch(kind: str, *points: tuple[float, float]) -> None:
        client.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": [{"x": x, "y": y} for x, y in points]})

    with motion(page):
        touch("touchStart", (180, 300))
        touch("touchMove", (220, 310))
        touch("touchMove", (260, 320))
        touch("touchEnd")
    with motion(page, eye):
        touch("touchStart", (140, 300), (220, 300))
        touch("touchMove", (120, 300), (240, 300))
        touch("touchMove", (80, 300), (280, 300))
        touch("touchEnd")
    page.locator(".dock label[for=mode-fly]").tap()
    assert mode(page) == "fly"
    box = page.locator(".joystick").bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    with motion(page, eye) as changed:
        touch("touchStart", (x, y - 30))
        changed()
        touch("touchEnd")


def test_a_gamepad_moves_looks_and_runs_actions(visit: Open) -> None:
    page = visit()
    with motion(page) as changed:
        page.evaluate("""() => {
            const buttons = Array.from({length: 17}, () => ({pressed: false, value: 0}));
            window.pad = {index: 0, connected: true, mapping: "standard", axes: [0, 0, 0.8, 0], buttons};
            navigator.getGamepads = () => [window.pad];
            window.dispatchEvent(new Event("gamepadconnected"));
        }""")
        changed()
        page.evaluate("pad.axes = [0, 0, 0, 0]")
    with motion(page, eye) as changed:
        page.evaluate("pad.axes = [0, -1, 0, 0]")
        changed()
        page.evaluate("pad.axes = [0, 0, 0, 0]")
    page.evaluate("pad.buttons[0] = {pressed: true, value: 1}")
    page.wait_for_function("() => document.documentElement.dataset.mode === 'orbit'")
    page.evaluate("pad.buttons[0] = {pressed: false, value: 0}; pad.connected = false")


def test_the_view_is_in_the_address_and_addresses_change_the_view(visit: Open) -> None:
    page = visit(f"{ROOM}#eye=1,1,1.6&to=4,2,1&fov=50&mode=fly")
    assert eye(page) == pytest.approx([1, 1, 1.6])
    assert mode(page) == "fly"
    assert page.evaluate("fake.camera.fovY") == pytest.approx(0.8726646, abs=1e-6)
    with motion(page, eye):
        page.evaluate("location.hash = '#eye=2,2,1.6&to=4,2,1&mode=fly'")
    assert eye(page) == pytest.approx([2, 2, 1.6], abs=1e-3)
    with motion(page):
        drag(page, 90, 0)
    page.wait_for_function("() => !location.hash.includes('to=4,2,1&')")


@pytest.mark.parametrize(
    ("hash_", "words"),
    [("#eye=1,2&to=x", "could not be read"), ("#eye=9e5,0,0&to=0,0,0", "outside of the scene")],
)
def test_a_view_that_cannot_be_is_said(visit: Open, hash_: str, words: str) -> None:
    page = visit(ROOM + hash_)
    page.wait_for_function("words => document.querySelector('.toast').textContent.includes(words)", arg=words)
    assert abs(eye(page)[2] - 1.6) < 1e-3


def test_settings_give_views_for_number_keys_and_buttons(visit: Open) -> None:
    page = visit(f"{ROOM}?settings=settings.json")
    assert eye(page)[:2] == pytest.approx([1, 1], abs=1e-6)
    page.keyboard.press("2")
    page.wait_for_function("() => Math.abs(fake.camera.position[0] - 2) < 1e-3")
    assert page.locator(".view-name").text_content() == "Window"
    page.get_by_role("button", name="Next view").click()
    page.wait_for_function("() => Math.abs(fake.camera.position[0] - 5) < 1e-3")
    assert page.locator(".view-name").text_content() == HOSTILE
    page.keyboard.press("r")
    page.wait_for_function("() => Math.abs(fake.camera.position[0] - 1) < 1e-3")


def test_settings_that_are_not_there_are_said_and_stop_nothing(visit: Open, address: str) -> None:
    page = visit(f"{ROOM}?settings=show%20room")
    page.wait_for_function("() => document.querySelector('.toast').textContent.includes('settings')")
    assert mode(page) == "walk"


def test_an_animation_plays_until_somebody_moves(visit: Open) -> None:
    page = visit(f"{ROOM}?settings=tour.json")
    with motion_of_tour(page):
        assert mode(page) == "fly"
    play = page.get_by_role("button", name="Play the animation")
    assert play.get_attribute("aria-pressed") == "true"
    drag(page, 60, 0)
    page.wait_for_selector("[data-action=play][aria-pressed=false]")
    page.keyboard.press("k")
    with motion_of_tour(page):
        assert play.get_attribute("aria-pressed") == "true"
    page.keyboard.press("k")
    rest(page)


@pytest.mark.parametrize(("path", "options"), [
    (f"{ROOM}?settings=tour.json&noanim", {}), (f"{ROOM}?settings=tour.json", {"reduced_motion": "reduce"}),
    (f"{ROOM}?settings=tour.json#eye=1,1,1.6&to=3,1,1.6", {}),
])  # fmt: skip
def test_an_animation_waits_where_it_is_not_wanted(visit: Open, path: str, options: dict[str, str]) -> None:
    page = visit(path, size="phone", **options)
    rest(page)
    play = page.get_by_role("button", name="Play the animation")
    assert play.get_attribute("aria-pressed") == "false"
    assert page.evaluate(OUTSIDE) == []
    play.click()
    with motion_of_tour(page):
        pass


def test_options_change_what_is_drawn(visit: Open) -> None:
    page = visit()
    page.keyboard.press("o")
    page.get_by_text("Arrival", exact=True).click()
    assert page.evaluate("fake.paint") == "arrival"
    page.keyboard.press("g")
    assert page.evaluate("fake.paint") == "opacity"
    page.get_by_text("Weight", exact=True).click()
    page.wait_for_function("() => fake.paint === 'weight' && fake.marks.weight?.length === 100")
    page.get_by_role("switch", name="medium").click()
    assert page.evaluate("[0, 1, 2].map((i) => fake.levelsShown[i] ?? true)") == [True, False, True]
    page.get_by_role("switch", name="View-dependent color").click()
    assert page.evaluate("fake.termsShown") is False
    page.get_by_role("switch", name="Cells").click()
    assert page.locator("canvas.overlay").is_visible()
    page.keyboard.press("b")
    assert not page.locator("canvas.overlay").is_visible()
    page.get_by_label("Field of view").fill("90")
    page.wait_for_function("() => Math.abs(fake.camera.fovY - Math.PI / 2) < 1e-3")
    page.get_by_label("Pace").fill("1")
    assert page.get_by_label("Pace").get_attribute("aria-valuetext") == "2 \N{MULTIPLICATION SIGN}"
    page.keyboard.press("Escape")
    assert not page.locator(".side").is_visible()


def test_quality_bounds_what_is_drawn_and_an_automatic_one_draws_all_at_rest(visit: Open) -> None:
    page = visit()
    limits = "[fake.budget, fake.maxPixelRatio]"
    page.keyboard.press("o")
    assert page.get_by_label("Automatic").is_checked()
    page.get_by_text("Low", exact=True).click()
    assert page.evaluate(limits) == [250_000, 0.75]
    assert page.get_by_text("At most 250 k Gaussians").is_visible()
    page.get_by_text("Automatic", exact=True).click()
    assert page.evaluate(f"{limits}.every((x) => x === Infinity)")
    page = visit(f"{ROOM}?quality=medium&budget=1234.5")
    assert page.evaluate(limits) == [1234, 1]
    page = visit(f"{ROOM}?quality=none&budget=-3&visitor")
    assert page.evaluate(f"{limits}.every((x) => x === Infinity)")
    page.keyboard.press("o")
    assert page.get_by_label("Automatic").is_checked()


def test_themes_follow_the_system_or_the_choice(visit: Open) -> None:
    page = visit(color_scheme="light")
    theme = "document.documentElement.dataset.theme"
    assert page.evaluate(theme) == "light"
    assert page.evaluate("fake.background[0]") > 0.5
    page.emulate_media(color_scheme="dark")
    page.wait_for_function(f"() => {theme} === 'dark' && fake.background[0] < 0.5")
    page.keyboard.press("l")
    assert page.evaluate(theme) == "light"
    page.reload()
    page.wait_for_function(f"() => {theme} === 'light'")


def test_a_click_says_why_a_gaussian_is_here(visit: Open) -> None:
    page = visit()
    page.mouse.click(300, 500)  # elsewhere: two clicks at one place would be a double click
    assert not page.locator(".side").is_visible()
    page.get_by_role("button", name="Inspect").click()
    page.mouse.click(500, 400)
    side = page.locator(".side")
    side.get_by_text("Gaussian 52,110").wait_for()
    side.get_by_text("18 of 23 cells see it").wait_for()
    assert page.locator(".map .seeing").count() > 5
    assert page.locator(".globe .seen").count() > 5
    assert page.locator(".mark").is_visible()
    assert page.evaluate("fake.picks.at(-1)") == [500, 400]
    with motion(page):
        drag(page, 50, 0)
    assert not page.locator(".mark").is_visible()
    page.get_by_role("button", name="Close the panel").click()
    page.locator("canvas").first.focus()
    page.keyboard.press("Enter")
    side.get_by_text("Gaussian 52,110").wait_for()


def test_a_double_click_goes_there(visit: Open) -> None:
    page = visit()
    with motion(page, eye):
        page.mouse.dblclick(500, 400)


def test_statistics_help_and_hiding_by_button_and_key(visit: Open) -> None:
    page = visit()
    figures = page.get_by_role("region", name="Statistics")
    page.keyboard.press("t")
    page.wait_for_function("() => document.querySelector('[data-figure=gaussians]').textContent === '328 k of 781 k'")
    page.get_by_role("button", name="Statistics").click()
    assert not figures.is_visible()
    page.keyboard.press("?")
    dialog = page.get_by_role("dialog")
    assert dialog.get_by_text("Full screen").is_visible()
    page.keyboard.press("Escape")
    assert not dialog.is_visible()
    page.get_by_role("button", name="Help").click()
    page.get_by_role("button", name="Close the help").click()
    assert not dialog.is_visible()
    page.keyboard.press("x")
    assert not page.locator(".tools").is_visible()
    page.keyboard.press("x")
    assert page.locator(".tools").is_visible()


def test_pictures_links_and_full_screen(visit: Open, address: str) -> None:
    page = visit(permissions=["clipboard-read", "clipboard-write"])
    with page.expect_download() as waiting:
        page.get_by_role("button", name="Save picture").click()
    assert waiting.value.suggested_filename == "show_room.png"
    assert Path(waiting.value.path()).read_bytes()[:4] == b"\x89PNG"
    page.get_by_role("button", name="Copy link").click()
    page.get_by_text("The link to this view is copied.").wait_for()
    assert page.evaluate("navigator.clipboard.readText()").startswith(f"{address}{ROOM}#eye=")
    page.keyboard.press("f")
    page.wait_for_function("() => document.fullscreenElement !== null")
    page.keyboard.press("f")
    page.wait_for_function("() => document.fullscreenElement === null")


def test_hotspots_show_title_text_and_link_and_hide_behind_walls(visit: Open) -> None:
    page = visit(f"{ROOM}?settings=spots.json")
    table, wall, behind = page.locator(".spot").all()
    table.wait_for()
    page.wait_for_function("() => document.querySelectorAll('.spot')[1].hasAttribute('data-behind')")
    assert wall.is_hidden()  # the stand-in for the core meets something 3.2 units away
    assert behind.is_hidden()  # behind the eye
    page.evaluate("document.addEventListener('gsvis-hotspot', ({detail}) => { window.spot = detail; })")
    table.focus()
    assert table.get_by_text("Table").is_visible()
    with motion(page, eye):
        page.keyboard.press("Enter")
    card = page.locator(".spot-card")
    assert card.get_by_role("heading").text_content() == "Table"
    link = card.get_by_role("link")
    assert (link.get_attribute("href"), link.get_attribute("rel")) == (
        "https://example.org/table",
        "noopener noreferrer",
    )
    assert page.evaluate("spot.index") == 0
    page.evaluate((VIEWER / "node_modules/axe-core/axe.min.js").read_text())
    assert page.evaluate(AXE) == []
    page.keyboard.press("Escape")
    assert card.is_hidden()
    assert page.evaluate("document.activeElement.className") == "spot"


def test_a_visitor_sees_no_inspector_and_no_counts(visit: Open) -> None:
    page = visit(f"{ROOM}?visitor")
    page.evaluate("fake.become({kind: 'complete'}, 1)")
    assert page.locator(".state").text_content() == ""
    for key in "igtb":
        page.keyboard.press(key)
    assert page.get_by_role("button", name="Inspect").count() == 0
    assert page.locator(".statistics").is_hidden()
    page.keyboard.press("o")
    assert page.get_by_text("Field of view").is_visible()
    assert page.get_by_text("Color shows").count() == 0


@pytest.mark.parametrize("query", ["", "?noui"])
def test_a_click_or_touch_leaves_no_ring_around_the_scene_a_key_does(visit: Open, query: str) -> None:
    page = visit(ROOM + query, has_touch=True)
    ring = "getComputedStyle(document.querySelector('main canvas')).outlineStyle"
    for press in (page.mouse.click, page.touchscreen.tap):
        press(600, 400)
        page.keyboard.press("ArrowLeft")
        assert page.evaluate("document.activeElement.tagName") == "CANVAS"
        assert page.evaluate(ring) == "none"
    page.evaluate("document.activeElement.blur()")
    page.keyboard.press("Tab")
    page.locator("main canvas").first.focus()
    assert page.evaluate(ring) == "solid"


def test_a_server_that_never_answers_is_not_called_a_lost_connection(visit: Open) -> None:
    page = visit(f"{ROOM}?silent", ready=False)
    page.wait_for_function("() => window.fake")
    for _ in range(4):
        page.evaluate("fake.become({kind: 'waiting', seconds: 2, message: 'scene.json: no connection'})")
        page.evaluate("fake.become({kind: 'connecting'})")
    card = page.get_by_role("alert")
    card.get_by_text("No answer from the scene's server").wait_for()
    assert page.get_by_text("The connection is lost").count() == 0
    page.evaluate("fake.become({kind: 'streaming'})")
    card.wait_for(state="hidden")


def test_a_lost_connection_a_lost_picture_and_their_return_are_said(visit: Open) -> None:
    page = visit()
    page.evaluate("fake.become({kind: 'waiting', seconds: 5, message: 'closed'})")
    page.get_by_text("The connection is lost.").wait_for()
    assert page.locator(".state").text_content() == "Retrying in 5 s"
    page.evaluate("fake.become({kind: 'streaming'})")
    page.get_by_text("Connected again.").wait_for()
    page.evaluate("fake.dispatchEvent(new Event('contextlost'))")
    page.get_by_text("The graphics card has taken the picture back.").wait_for()
    page.evaluate("fake.dispatchEvent(new Event('contextrestored'))")
    page.wait_for_function("() => document.querySelector('.toast').textContent === ''")
    page.evaluate("fake.become({kind: 'complete'}, 0.8)")
    page.wait_for_function("() => document.querySelector('.title').dataset.state === 'complete'")


def test_a_refused_token_can_be_entered_and_a_failure_tried_again(visit: Open) -> None:
    page = visit()
    page.evaluate("fake.become({kind: 'failed', message: 'a token is needed', code: 4})")
    page.get_by_label("Token").fill("secret")
    page.keyboard.press("Enter")
    page.wait_for_function(
        "() => window.asked?.length === 1 && asked[0] === 'secret' && window.fake?.state.kind === 'streaming'"
    )
    assert not page.locator(".card").is_visible()
    page.evaluate("fake.become({kind: 'failed', message: '<b>gone</b>'})")
    assert page.locator(".card code").text_content() == "<b>gone</b>"
    page.get_by_role("button", name="Try again").click()
    page.wait_for_function("() => asked.length === 2 && fake.state.kind === 'streaming'")


def test_without_webgl2_the_page_says_so(visit: Open) -> None:
    page = visit(f"{ROOM}?nowebgl", ready=False)
    page.locator(".card h2").wait_for()
    title = page.locator(".card h2").text_content()
    assert title in ("The scene cannot be loaded", "This browser cannot draw the scene")


def test_noui_shows_only_the_scene(visit: Open) -> None:
    page = visit(f"{ROOM}?noui")
    assert not page.locator(".tools").is_visible()
    assert page.locator("canvas").first.is_visible()


def test_the_list_links_to_scenes_and_shows_names_as_text(visit: Open) -> None:
    page = visit("/", ready=False)
    page.get_by_role("link", name="show room").wait_for()
    assert page.get_by_role("link").count() == 2
    assert page.get_by_text(HOSTILE).is_visible()
    page.get_by_role("link", name="show room").click()
    page.wait_for_url("**/view/show%20room*")


@pytest.mark.parametrize("scheme", ["dark", "light"])
@pytest.mark.parametrize("size", list(SIZES))
def test_axe_finds_nothing_and_nothing_is_wider_than_the_window(visit: Open, size: str, scheme: str) -> None:
    axe = VIEWER / "node_modules" / "axe-core" / "axe.min.js"
    if not axe.exists():
        pytest.skip("no axe-core: run npm ci in viewer/")
    options: dict[str, Any] = {"color_scheme": scheme, "bypass_csp": True}
    if size == "phone":
        options |= {"has_touch": True, "is_mobile": True}
    page = visit(f"{ROOM}?settings=tour.json&noanim", size=size, **options)
    page.evaluate(axe.read_text())
    for show in ("scene", "statistics", "options", "why", "help", "failed"):
        arrange(page, show)
        assert (show, page.evaluate(AXE)) == (show, [])
        assert (show, page.evaluate(OUTSIDE)) == (show, [])
        assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
        if show == "help":
            page.keyboard.press("Escape")


@pytest.mark.parametrize("scheme", ["dark", "light"])
def test_axe_finds_nothing_in_the_list(visit: Open, scheme: str) -> None:
    axe = VIEWER / "node_modules" / "axe-core" / "axe.min.js"
    if not axe.exists():
        pytest.skip("no axe-core: run npm ci in viewer/")
    page = visit("/", size="phone", ready=False, color_scheme=scheme, bypass_csp=True)
    arrange(page, "list")
    page.evaluate(axe.read_text())
    assert page.evaluate(AXE) == []
    assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")


def arrange(page: Any, show: str) -> None:
    """Bring the page into one of its states."""
    if show == "options":
        page.keyboard.press("o")
    elif show == "why":
        page.locator("canvas").first.focus()
        page.keyboard.press("Enter")
        page.locator(".globe").wait_for()
    elif show == "help":
        page.keyboard.press("?")
    elif show == "statistics":
        page.keyboard.press("t")
    elif show == "failed":
        page.evaluate("fake.become({kind: 'failed', message: 'a token is needed', code: 4})")
    elif show == "list":
        page.get_by_role("link").first.wait_for()
