"""What a publisher sets of a page: it arrives in the page, can be read, and what makes no sense is refused."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from gsvis.errors import FormatError
from gsvis.export import PageOptions, check_page, write_html, write_site
from gsvis.export.publish import accents, contrast
from gsvis.scene.procedural import two_rooms
from tests.viewer.browser import viewer_files

SCENE = two_rooms(1000, sh_degree=0).gaussians
SUPERSPLAT = {
    "version": 2,
    "background": {"color": [0.1, 0.2, 0.3]},
    "cameras": [{"initial": {"position": [1, 2, 3], "target": [0, 0, 0], "fov": 75}}],
}


def rgb(color: str) -> tuple[float, float, float]:
    red, green, blue = (int(color[k : k + 2], 16) / 255 for k in (1, 3, 5))
    return red, green, blue


@pytest.mark.parametrize("color", ["#000000", "#ffffff", "#d4380d", "#ffd700", "#1c5fd4", "#777777", "#00ff00"])
def test_every_accent_can_be_read_on_panels_and_under_its_text(color: str) -> None:
    dark, on_dark, light, on_light = accents(color)
    for accent, panel in ((dark, "#15181d"), (light, "#ffffff")):
        assert contrast(rgb(accent), rgb(panel)) >= 4.4  # rounded to whole steps of 255
    for accent, ink in ((dark, on_dark), (light, on_light)):
        assert contrast(rgb(accent), rgb(ink)) >= 4.4


def test_contrast_is_that_of_wcag() -> None:
    assert contrast((0, 0, 0), (1, 1, 1)) == pytest.approx(21)
    assert contrast(rgb("#777777"), (1, 1, 1)) == pytest.approx(4.48, abs=0.01)


def test_a_site_holds_what_its_publisher_chose(tmp_path: Path) -> None:
    viewer_files()
    (tmp_path / "s.json").write_text(json.dumps(SUPERSPLAT))
    (tmp_path / "p.JPG").write_bytes(b"jpeg")
    page = PageOptions(
        title='A "house" & more', settings=tmp_path / "s.json", poster=tmp_path / "p.JPG", backdrop="#102030",
        og_image="https://example.org/p.png", visitor=True, embedders=("https://blog.example",),
    )  # fmt: skip
    found = write_site(tmp_path / "site", SCENE, page=page)
    text = (tmp_path / "site" / "index.html").read_text()
    assert "<title>A &quot;house&quot; &amp; more</title>" in text
    for line in (
        '<meta name="gsvis-background" content="#102030">',
        '<meta name="gsvis-visitor" content="true">',
        '<meta name="gsvis-embedders" content="https://blog.example">',
        '<meta property="og:image" content="https://example.org/p.png">',
        '<main class="scene"><img class="poster" src="poster.jpg" alt="">',
    ):
        assert line in text
    assert (tmp_path / "site" / "poster.jpg").read_bytes() == b"jpeg"
    assert json.loads((tmp_path / "site" / "settings.json").read_text()) == SUPERSPLAT
    assert found.nbytes == sum(each.stat().st_size for each in (tmp_path / "site").rglob("*") if each.is_file())


def test_one_file_holds_its_poster_and_settings_itself(tmp_path: Path) -> None:
    viewer_files()
    (tmp_path / "p.png").write_bytes(b"png")
    write_html(tmp_path / "one.html", SCENE, page=PageOptions(poster=tmp_path / "p.png", accent="#d4380d"))
    text = (tmp_path / "one.html").read_text()
    assert 'src="data:image/png;base64,cG5n"' in text
    assert 'name="gsvis-accent"' in text


def test_options_of_a_page_that_make_no_sense_are_refused(tmp_path: Path) -> None:
    (tmp_path / "p.gif").write_bytes(b"gif")
    for bad in ({"backdrop": "blue"}, {"accent": "#12"}, {"poster": tmp_path / "p.gif"}):
        with pytest.raises(ValueError, match="expected"):
            check_page(PageOptions(**bad))  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="embedders"):
        check_page(PageOptions(embedders=("blog.example",)))
    for text in ("[1]", "{", '{"version": 3}'):
        (tmp_path / "s.json").write_text(text)
        with pytest.raises(FormatError, match="settings"):
            check_page(PageOptions(settings=tmp_path / "s.json"))
