"""The page in another language: chosen by the address, the publisher or the browser, without a word of English left."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from gsvis.export import PageOptions, write_html
from gsvis.export.publish import LANGUAGES
from gsvis.scene.procedural import two_rooms
from tests.viewer.browser import page_in
from tests.viewer.page_server import AXE, VIEWER

pytestmark = pytest.mark.slow
CHROMIUM = ("--disable-gpu",)  # nothing here draws with WebGL, and software in its place costs most of a test
WORDS = VIEWER / "src" / "page" / "words"
ROOM = "/view/show%20room?settings=spots.json"
STREAMS = "() => document.documentElement.dataset.state === 'streaming' && location.hash.length > 1"
SAID = """() => [...document.querySelectorAll("*:not(script, style)")].flatMap((each) => [
    ...[...each.childNodes].filter((node) => node.nodeType === 3).map((node) => node.data.trim()),
    ...["aria-label", "title", "aria-valuetext"].map((name) => each.getAttribute(name)?.replace(/ \\(.\\)$/, "")),
]).filter(Boolean)"""


def forms(language: str) -> dict[str, list[str]]:
    """Return the texts of a language, each in all its forms."""
    found = json.loads((WORDS / f"{language}.json").read_text())
    return {key: [text] if isinstance(text, str) else list(text.values()) for key, text in found.items()}


def english_alone() -> set[str]:
    """Return the English texts that no German text is like."""
    german = {text for texts in forms("de").values() for text in texts}
    return {text for texts in forms("en").values() for text in texts} - german - {"low", "high"}  # names of levels


def test_the_languages_of_exports_are_those_of_the_page() -> None:
    assert set(LANGUAGES) == {path.stem for path in WORDS.glob("*.json")}


def test_a_page_in_german_has_no_english_and_nothing_for_axe(browser: Any, address: str) -> None:
    axe = VIEWER / "node_modules" / "axe-core" / "axe.min.js"
    if not axe.exists():
        pytest.skip("no axe-core: run npm ci in viewer/")
    with page_in(browser, address + ROOM, locale="de-AT", bypass_csp=True) as (page, said):
        page.get_by_role("button", name="Hilfe").wait_for()
        assert page.evaluate("document.documentElement.lang") == "de"
        page.wait_for_function(STREAMS)
        page.evaluate(axe.read_text())
        page.evaluate("fake.become({kind: 'complete'}, 1)")
        for key in "ot?":
            page.keyboard.press(key)
            assert set(page.evaluate(SAID)) & english_alone() == set()
            assert page.evaluate(AXE) == []
        page.keyboard.press("Escape")
        page.locator("main > canvas").first.focus()
        page.keyboard.press("Enter")
        page.get_by_text("Er ist hier, weil 18 von 23 Zellen ihn sehen.").wait_for()
        page.get_by_text("781 k Gaussians").first.wait_for(state="attached")
        page.get_by_text("62\u00a0%").first.wait_for(state="attached")
        assert set(page.evaluate(SAID)) & english_alone() == set()
        assert said == []


def test_an_address_names_the_language_one_that_is_unknown_or_does_not_come_leaves_english(
    browser: Any, address: str
) -> None:
    for query, locale, language in (("lang=tlh", "fr-FR", "en"), ("lang=en", "de-DE", "en"), ("lang=de", "en", "de")):
        with page_in(browser, f"{address}{ROOM}&{query}", locale=locale) as (page, said):
            page.get_by_role("button", name="Hilfe" if language == "de" else "Help").wait_for()
            assert page.evaluate("document.documentElement.lang") == language
            assert said == []
    opened = browser.new_context(locale="de-DE")
    page = opened.new_page()
    page.route("**/words-de.js", lambda route: route.abort())
    page.goto(address + ROOM)
    page.get_by_role("button", name="Help").wait_for()
    opened.close()


def test_the_list_of_scenes_speaks_german(browser: Any, address: str) -> None:
    with page_in(browser, address, locale="de-DE") as (page, _):
        page.get_by_role("link").first.wait_for()
        assert page.get_by_role("heading").inner_text() == "Szenen"
        assert page.title() == "Szenen · gsvis"
        assert set(page.evaluate(SAID)) & english_alone() == set()


def test_one_file_of_a_publisher_speaks_german_from_disk(browser: Any, tmp_path: Path) -> None:
    write_html(tmp_path / "one.html", two_rooms(1000, sh_degree=0).gaussians, page=PageOptions(language="de"))
    assert '<html lang="de">' in (tmp_path / "one.html").read_text()
    with page_in(browser, (tmp_path / "one.html").as_uri(), locale="en-US") as (page, _):
        page.get_by_role("button", name="Hilfe").wait_for()
        assert page.evaluate("document.documentElement.lang") == "de"
