from __future__ import annotations

import json
import os
import re
from dataclasses import replace
from functools import cache
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from gsvis.cli.targets import check_report
from gsvis.raycast import Analysis, AnalysisConfig, EllipsoidProxies, Tracer, analyze
from gsvis.report import Subject, ViewPicture, picture_views, report_document, write_report
from gsvis.report.maps import Ground
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.inspection import inspect_scene
from gsvis.scene.procedural import two_rooms

pytestmark = pytest.mark.usefixtures("coarse_plots")
AWKWARD = "<b>\"rooms\" & 'halls'</b> $title"


@cache
def made() -> tuple[Analysis, Subject, list[ViewPicture]]:
    scene = two_rooms(2000, sh_degree=1)
    g = scene.gaussians
    cameras = scene.navigable.sample_cameras(5, np.random.default_rng(0), width=16, height=12)
    tracer = Tracer(EllipsoidProxies.from_scene(g))
    config = AnalysisConfig(traced_sample=200, rays_per_face=1)
    found = analyze(g, cameras, config, navigable=scene.navigable, tracer=tracer)
    facts = inspect_scene(g).as_dict()
    subject = Subject(
        AWKWARD, g, scene.up, "sampled", "gsvis analyze <x> & y", "0", facts, {"a<b": "<c>", "lod": None}, differs=""
    )
    return found, subject, picture_views(tracer, found, longest_side=32)


class Outline(HTMLParser):
    """Collects tags, sources and text, and checks that tags nest."""

    VOID = ("meta", "img", "source", "br", "link")

    def __init__(self, html: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: list[str] = []
        self.links: list[str] = []
        self.images: list[dict[str, str | None]] = []
        self.words: list[str] = []
        self.feed(html)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.links += [str(value) for name, value in attrs if name in ("src", "srcset", "href")]
        if tag == "img":
            self.images.append(dict(attrs))
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.words.append(data)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("report") / "new" / "folder"
    write_report(path, *made())
    return path


def test_the_folder_holds_the_page_the_document_and_the_pictures(folder: Path) -> None:
    roles = ("most", "median", "least")
    names = {"report.json", "report.html", "timings.json", "visible.png", "cdf.png", "map_directions.png"}
    names |= {f"{kind}_{role}.png" for kind in ("view", "map") for role in roles}
    assert {path.name for path in folder.iterdir()} == names
    for path in folder.glob("*.png"):
        with Image.open(path) as image:
            image.load()
            assert image.getextrema() != ((0, 0),) * 3
            assert path.name != "view_most.png" or image.size == (32, 24)


@pytest.mark.usefixtures("blank_plots")
def test_other_files_stay_and_pictures_of_an_earlier_report_go(tmp_path: Path) -> None:
    for name in ("notes.txt", "settling.png", "cdf.png"):
        (tmp_path / name).write_text("old")
    write_report(tmp_path, *made())
    assert (tmp_path / "notes.txt").read_text() == "old"
    assert not (tmp_path / "settling.png").exists()
    assert (tmp_path / "cdf.png").read_bytes()[1:4] == b"PNG"


@pytest.mark.usefixtures("blank_plots")
@pytest.mark.parametrize("can_swap", [True, False])
def test_an_interrupt_while_a_report_is_moved_leaves_the_older_one(
    tmp_path: Path, can_swap: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    (found, subject, pictures), move, moved, limits = made(), os.replace, list[str](), list[int]()

    def stopped(source: Path, destination: Path) -> None:
        moved.append(Path(destination).name)
        if len(moved) == limits[-1]:
            raise KeyboardInterrupt
        move(source, destination)

    folder = tmp_path / "report"
    write_report(folder, found, subject, pictures)
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    if not can_swap:
        monkeypatch.setattr("gsvis.files.atomic.swap_folder", lambda *_: False)
        monkeypatch.setattr("gsvis.files.atomic.os.replace", stopped)
        for limit in (1, 2):
            limits.append(limit)
            moved.clear()
            with pytest.raises(KeyboardInterrupt):
                write_report(folder, found, subject, pictures[:1])
            assert {path.name: path.read_bytes() for path in folder.iterdir()} == before
            check_report(folder)  # the next run may write there
        limits.append(99)
        moved.clear()
    write_report(folder, found, subject, pictures[:1])
    if not can_swap:
        assert moved[-2:] == ["report.html", "report.json"]
    assert [path.name for path in tmp_path.iterdir()] == ["report"]


def test_the_document_says_what_it_is_and_holds_every_figure(folder: Path) -> None:
    found, subject, _ = made()
    document = json.loads((folder / "report.json").read_text(encoding="utf-8"))
    assert document == json.loads(json.dumps(report_document(found, subject)))
    assert (document["format"], document["version"]) == ("gsvis-report", 1)
    assert document["scene"]["name"] == AWKWARD
    assert document["scene"]["count"] == document["gaussians"] == len(subject.gaussians)


def test_the_page_is_whole_and_needs_nothing_else(folder: Path) -> None:
    html = (folder / "report.html").read_text(encoding="utf-8")
    outline = Outline(html)
    assert outline.open == []
    assert all(link.startswith("data:image/png;base64,") for link in outline.links)
    assert not {"script", "iframe", "link"} & set(outline.tags)
    assert "url(" not in html
    assert re.search(r'name="viewport"', html)
    assert "prefers-color-scheme: dark" in html


def test_every_picture_has_words(folder: Path) -> None:
    outline = Outline((folder / "report.html").read_text(encoding="utf-8"))
    assert outline.tags.count("figure") == outline.tags.count("figcaption") == len(outline.images) == 9
    assert all(image["alt"] for image in outline.images)


def test_names_from_outside_are_text_not_markup(folder: Path) -> None:
    outline = Outline((folder / "report.html").read_text(encoding="utf-8"))
    text = "".join(outline.words)
    assert AWKWARD in text
    assert "gsvis analyze <x> & y" in text
    assert "a<b" in text
    assert "b" not in outline.tags


def test_resolution_and_field_of_view_stand_beside_the_fractions(folder: Path) -> None:
    text = "".join(Outline((folder / "report.html").read_text(encoding="utf-8")).words)
    assert text.count("16 x 12 pixel rays") >= 2
    assert "field of view 60°" in text
    assert "20.21%" in text
    assert "39.4%" in text
    assert "80.4%" in text


@pytest.mark.usefixtures("blank_plots")
def test_the_paper_stands_apart_where_it_does_not_compare(tmp_path: Path) -> None:
    found, subject, pictures = made()
    document = write_report(tmp_path, found, replace(subject, differs="made of <air>"), pictures)
    text = "".join(Outline((tmp_path / "report.html").read_text(encoding="utf-8")).words)
    assert "do not compare with these: made of <air>" in text
    assert "39.4%" not in text
    assert "by solid angle" in text
    assert (document["paper"]["comparable"], document["paper"]["differs"]) == (False, "made of <air>")


def test_pictures_show_the_views_they_name() -> None:
    found, _, pictures = made()
    by_role = {picture.role: picture for picture in pictures}
    assert found.visible[by_role["most"].camera] == found.visible.max()
    assert found.visible[by_role["least"].camera] == found.visible.min()
    assert found.visible[by_role["median"].camera] == np.median(found.visible)
    for picture in pictures:
        assert np.count_nonzero(picture.visible) == found.visible[picture.camera]


def test_one_camera_without_tracing_still_makes_a_report(tmp_path: Path) -> None:
    _, subject, _ = made()
    g = subject.gaussians
    tracer = Tracer(EllipsoidProxies.from_scene(g))
    one = analyze(g, made()[0].cameras[0], tracer=tracer)
    pictures = picture_views(tracer, one, longest_side=16)
    assert [picture.role for picture in pictures] == ["most"]
    write_report(tmp_path, one, subject, pictures)
    text = "".join(Outline((tmp_path / "report.html").read_text(encoding="utf-8")).words)
    assert "not traced outward: no navigable space was given" in text
    assert "One view" in text


@pytest.mark.usefixtures("blank_plots")
def test_nothing_is_written_when_writing_is_interrupted(tmp_path: Path) -> None:
    def stop(stage: str, done: int, total: int) -> None:
        if done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_report(tmp_path / "out", *made(), progress=stop)
    assert list(tmp_path.iterdir()) == []


def test_a_report_is_the_same_every_time(folder: Path, tmp_path: Path) -> None:
    write_report(tmp_path, *made())
    for path in folder.iterdir():
        assert path.read_bytes() == (tmp_path / path.name).read_bytes(), path.name


@pytest.mark.parametrize("up", [(0, 0, 1), (0, -1, 0), (1, 0, 0), (0.6, 0.0, 0.8)])
def test_a_map_is_seen_from_above(up: tuple[float, float, float]) -> None:
    g = made()[1].gaussians
    ground = Ground.from_scene(g, up)
    assert np.cross(ground.right, ground.onward) == pytest.approx(up)
    assert ground.project(g.means.astype(float)) == pytest.approx(ground.places)


def test_a_map_holds_eyes_far_outside() -> None:
    ground = Ground.from_scene(made()[1].gaussians, (0, 0, 1), np.array([[100.0, -50.0, 3.0]]))
    assert np.all(ground.box[1] > [100.0, -1.0])
    assert np.all(ground.box[0] < [0.0, -50.0])


def test_a_scene_of_one_gaussian_can_be_drawn(tmp_path: Path) -> None:
    _, subject, _ = made()
    g = Gaussians([[0, 3, 0]], [[1, 0, 0, 0]], np.full((1, 3), 0.1), [0.9], np.zeros((1, 1, 3)))
    tracer = Tracer(EllipsoidProxies.from_scene(g))
    cameras = made()[0].cameras[:2]
    alone = Subject("one", g, subject.up, "sampled", "gsvis", "0")
    found = analyze(g, cameras, tracer=tracer)
    write_report(tmp_path, found, alone, picture_views(tracer, found, longest_side=8))
    with Image.open(tmp_path / "map_most.png") as image:
        assert image.width > 100
