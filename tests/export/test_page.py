"""A site and a one-file page, with a stand-in for the viewer."""

from __future__ import annotations

import base64
import hashlib
import json
import re
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from gsvis.errors import BackendError
from gsvis.export import StaticOptions, write_html, write_site, write_static
from gsvis.export.page import check_site
from gsvis.export.publish import PageOptions
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.procedural import random_scene
from tests.export.test_static import Reader
from tests.export.viewers import viewer_of

HOSTILE = '"><script>alert(1)</script>\u2028&'


class Elements(HTMLParser):
    """Elements of a page with their attributes and text."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.found: list[tuple[str, dict[str, str | None], str]] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found.append((tag, dict(attrs), ""))

    def handle_endtag(self, tag: str) -> None:
        self.found.append((f"/{tag}", {}, ""))

    def handle_data(self, data: str) -> None:
        if self.found:
            tag, attrs, text = self.found[-1]
            self.found[-1] = tag, attrs, text + data

    def metas(self) -> dict[str | None, str | None]:
        return {a.get("name") or a.get("http-equiv"): a.get("content") for tag, a, _ in self.found if tag == "meta"}


@pytest.fixture
def viewer(tmp_path: Path) -> Path:
    return viewer_of(tmp_path / "viewer")


@pytest.fixture
def scene() -> Gaussians:
    return random_scene(np.random.default_rng(2), 200, sh_degree=1)


def test_a_site_has_the_page_its_scripts_and_the_scene(viewer: Path, scene: Gaussians, tmp_path: Path) -> None:
    made = write_site(tmp_path / "site", scene, StaticOptions(name=HOSTILE), viewer=viewer)
    assert made.nbytes == sum(p.stat().st_size for p in (tmp_path / "site").rglob("*") if p.is_file())
    page = Elements((tmp_path / "site" / "index.html").read_text(encoding="utf-8"))
    metas = page.metas()
    assert (metas["gsvis-content"], metas["gsvis-scene"], metas["gsvis-settings"]) == (
        "scene/",
        HOSTILE,
        "settings.json",
    )
    scripts = [(a.get("src"), text.strip()) for tag, a, text in page.found if tag == "script"]
    (_, early), last = scripts
    assert last == ("viewer/page.js", "")
    rules = [rule.split() for rule in str(metas["Content-Security-Policy"]).split(";")]
    digest = base64.b64encode(hashlib.sha256(early.encode()).digest()).decode()
    assert ["script-src", "'self'", f"'sha256-{digest}'"] in rules
    assert ["connect-src", "'self'"] in rules
    for name in ("page.js", "sort.js", "static.js", "page.css"):
        assert (tmp_path / "site" / "viewer" / name).read_bytes() == (viewer / name).read_bytes()
    assert len(Reader(tmp_path / "site" / "scene").ids) == 200
    settings = json.loads((tmp_path / "site" / "settings.json").read_bytes())
    pose, view = Reader(tmp_path / "site" / "scene").scene["poses"][0], settings["cameras"][0]["initial"]
    assert (settings["frame"], view["position"]) == ("scene", pose["position"])
    assert np.linalg.norm(np.array(view["target"]) - view["position"]) > 0.1


def test_a_page_asks_early_for_files_that_are_there(viewer: Path, scene: Gaussians, tmp_path: Path) -> None:
    write_site(tmp_path / "site", scene, viewer=viewer)
    text = (tmp_path / "site" / "index.html").read_text(encoding="utf-8")
    (names,) = re.findall(r'\["scene.json"\] : (\[.*?\])', text)
    links = re.findall(r'<link rel="preload"[^>]* href="([^"]+)"', text)
    assert len(json.loads(names)) == 4
    assert [name for name in json.loads(names) if not (tmp_path / "site" / "scene" / name).is_file()] == []
    assert [name for name in links if not (tmp_path / "site" / name).is_file()] == []


def test_a_page_with_views_of_its_own_asks_early_for_the_scene_alone(
    viewer: Path, scene: Gaussians, tmp_path: Path
) -> None:
    settings = tmp_path / "mine.json"
    settings.write_text('{"version": 2, "cameras": []}', encoding="utf-8")
    write_site(tmp_path / "site", scene, viewer=viewer, page=PageOptions(settings=settings))
    assert '["scene.json"] : ["scene.json"] }' in (tmp_path / "site" / "index.html").read_text(encoding="utf-8")


@pytest.mark.parametrize("scale", [1e-3, 2.0**-20, 1e3])
def test_what_a_view_looks_at_is_in_the_units_of_the_scene(
    viewer: Path, scene: Gaussians, tmp_path: Path, scale: float
) -> None:
    views = []
    for factor in (1.0, scale):
        site = tmp_path / f"site{factor}"
        write_site(site, scene.transform(np.eye(3), scale=factor), viewer=viewer)
        views.append(json.loads((site / "settings.json").read_bytes())["cameras"][0]["initial"])
    for key in ("position", "target"):
        np.testing.assert_allclose(np.array(views[1][key]) / scale, views[0][key], rtol=2e-3, atol=2e-3)


def test_settings_of_a_person_stay_and_other_files_too(viewer: Path, scene: Gaussians, tmp_path: Path) -> None:
    site = tmp_path / "site"
    write_site(site, scene, viewer=viewer)
    (site / "settings.json").write_text("{}")
    (site / "CNAME").write_text("example.org")
    check_site(site, overwrite=False)
    write_site(site, scene[:100], viewer=viewer)
    assert (site / "settings.json").read_text() == "{}"
    assert (site / "CNAME").exists()
    assert len(Reader(site / "scene").ids) == 100


@pytest.mark.parametrize("text", ["[]", "null", "3", '"gsvis"', "{", "[" * 100_000])
def test_settings_that_make_no_sense_stay(viewer: Path, scene: Gaussians, tmp_path: Path, text: str) -> None:
    write_site(tmp_path, scene[:20], viewer=viewer)
    (tmp_path / "settings.json").write_text(text)
    write_site(tmp_path, scene[:20], viewer=viewer)
    assert (tmp_path / "settings.json").read_text() == text


def test_settings_of_an_earlier_export_follow_the_scene(viewer: Path, scene: Gaussians, tmp_path: Path) -> None:
    for folder, written in (("twice", (scene, scene[:20])), ("once", (scene[:20],))):
        for each in written:
            write_site(tmp_path / folder, each, viewer=viewer)
    assert (tmp_path / "twice" / "settings.json").read_bytes() == (tmp_path / "once" / "settings.json").read_bytes()


def test_a_site_over_one_of_another_scene_has_no_settings_of_that(
    viewer: Path, scene: Gaussians, tmp_path: Path
) -> None:
    """Whether they are as an export left them, from an earlier version, half replaced, or changed by a person."""
    site, other = tmp_path / "site", StaticOptions("other")
    write_site(tmp_path / "fresh", scene[:20], other, viewer=viewer)
    expected = (tmp_path / "fresh" / "settings.json").read_bytes()
    for kind in ("as written", "no mark", "scene replaced", "changed"):
        write_site(site, scene, StaticOptions("one"), viewer=viewer)
        file = site / "settings.json"
        said = json.loads(file.read_bytes())
        if kind == "no mark":
            del said["gsvis"]
            file.write_text(json.dumps(said, indent=1) + "\n")
        elif kind == "scene replaced":
            write_static(site / "scene", scene[:50], other)
        elif kind == "changed":
            said["cameras"] = said["cameras"][:1]
            file.write_text(json.dumps(said))
        write_site(site, scene[:20], other, viewer=viewer)
        assert file.read_bytes() == expected, kind


def test_a_page_of_something_else_is_not_replaced(tmp_path: Path) -> None:
    (tmp_path / "index.html").write_text("mine")
    with pytest.raises(ValueError, match="something else"):
        check_site(tmp_path, overwrite=False)
    check_site(tmp_path, overwrite=True)


def test_one_file_holds_everything_and_asks_for_nothing(viewer: Path, scene: Gaussians, tmp_path: Path) -> None:
    made = write_html(tmp_path / "s.html", scene, StaticOptions(name=HOSTILE), viewer=viewer)
    text = (tmp_path / "s.html").read_text(encoding="utf-8")
    assert made.nbytes == len(text.encode())
    page = Elements(text)
    scripts = [(a, body) for tag, a, body in page.found if tag == "script"]
    held = {a["data-name"]: base64.b64decode(body) for a, body in scripts if a.get("type") == "text/gsvis"}
    (tmp_path / "out").mkdir()
    for name, data in held.items():
        assert name is not None
        (tmp_path / "out" / name).write_bytes(data)
    assert len(Reader(tmp_path / "out").ids) == 200
    assert page.metas()["gsvis-content"] == "inline:"
    workers = {a["data-name"]: base64.b64decode(body) for a, body in scripts if a.get("type") == "text/gsvis-worker"}
    assert workers == {name: (viewer / name).read_bytes() for name in ("sort.js", "static.js", "network.js")}
    running = [body for a, body in scripts if a.get("type") in (None, "module")]
    policy = str(page.metas()["Content-Security-Policy"])
    assert len(running) == 7  # what starts Workers, embedding, hotspots, animations, authoring, German, the page
    for body in running:
        assert f"'sha256-{base64.b64encode(hashlib.sha256(body.encode()).digest()).decode()}'" in policy
        assert "<!--" not in body
    style = next(body for tag, _, body in page.found if tag == "style")
    assert base64.b64encode(hashlib.sha256(style.encode()).digest()).decode() in policy
    assert "'unsafe" not in policy
    assert not [a for _, a, _ in page.found if a.get("src") or (a.get("href") and a["href"] != "data:,")]
    assert re.search(r"default-src 'none'", policy)


def test_the_same_scene_gives_the_same_page(viewer: Path, scene: Gaussians, tmp_path: Path) -> None:
    for name in ("a.html", "b.html"):
        write_html(tmp_path / name, scene, viewer=viewer)
    assert (tmp_path / "a.html").read_bytes() == (tmp_path / "b.html").read_bytes()


def test_a_viewer_that_is_not_built_is_named_before_anything_is_written(scene: Gaussians, tmp_path: Path) -> None:
    for write in (write_site, write_html):
        with pytest.raises(BackendError, match=r"not built.*make viewer"):
            write(tmp_path / "out.html", scene, viewer=tmp_path / "none")
    assert not (tmp_path / "out.html").exists()
