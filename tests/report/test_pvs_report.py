"""The report on visible sets: complete, self-contained, the same every time, and its maps."""

from __future__ import annotations

import json
import re
from functools import cache
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from gsvis.pvs.cells import CellGrid
from gsvis.pvs.quality import Quality, QualityConfig, measure_quality
from gsvis.pvs.store import CellSet, StoreInfo, VisibilityStore, write_store
from gsvis.pvs.viewpoints import CellViewpoints
from gsvis.report import Subject
from gsvis.report.maps import CellMap, Ground
from gsvis.report.pvs_document import count_above_limit, pvs_document, write_pvs_report
from gsvis.report.pvs_page import describe_certificate
from gsvis.scene.content import scene_hash
from gsvis.scene.procedural import two_rooms

pytestmark = pytest.mark.usefixtures("coarse_plots")
AWKWARD = "<b>\"rooms\" & 'halls'</b> $title"
PICTURES = {"map_visible", "visible", "viewpoints", "bounds", "missing", "map_missing", "classes"}
PICTURES |= {"worst_full", "worst_set", "worst_difference"}
QUICK = QualityConfig(cells=3, viewpoints=2, size=16, dense=2, width=24, height=18, certify=100)


class Outline(HTMLParser):
    """Collects tags, sources and text, and checks that tags nest."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: list[str] = []
        self.links: list[str] = []
        self.words: list[str] = []
        self.alternatives: list[str | None] = []
        self.feed(html)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.links += [str(value) for name, value in attrs if name in ("src", "srcset", "href")]
        if tag == "img":
            self.alternatives.append(dict(attrs).get("alt"))
        if tag not in ("meta", "img", "source", "br", "link"):
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.words.append(data)


def made(folder: Path, build: dict[str, float] | None = None, *, certified: bool = True) -> VisibilityStore:
    """A store in which each cell sees all but some Gaussians."""
    scene = two_rooms(1500, sh_degree=1)
    n, grid = len(scene.gaussians), CellGrid.over(scene.navigable, max_cells=8)
    cells = []
    for cell in range(len(grid)):
        ids = np.flatnonzero(np.arange(n) % 10 != cell)
        figures = {"rays": 256, "missed": 0.0005 * cell, "bound": 0.001 * cell, "tile": 0.02} if certified else {}
        cells.append(CellSet(ids, ids % 3, 4 + cell, cell % 3, **figures))
    edges = np.array([1 / 255, 1 / 16, 1 / 4])
    info = StoreInfo(n, scene_hash(scene.gaussians), 1 / 255, edges, build or {})
    write_store(folder / "rooms.pvs", grid, info, cells, np.zeros((n, 10), np.uint8))
    return VisibilityStore.open(folder / "rooms.pvs")


@cache
def subject() -> Subject:
    scene = two_rooms(1500, sh_degree=1)
    given = {"a<b": "<c>", "lod": None}
    return Subject(AWKWARD, scene.gaussians, scene.up, "anywhere", "gsvis <x> & y", "0", {}, given, {"quality": 1.0})


def measured(store: VisibilityStore, config: QualityConfig = QUICK) -> Quality:
    scene = two_rooms(1500, sh_degree=1)
    return measure_quality(store, scene.gaussians, CellViewpoints(store.grid, scene.navigable), config)


@pytest.fixture(scope="module")
def kept(tmp_path_factory: pytest.TempPathFactory) -> tuple[VisibilityStore, Quality, Path]:
    folder = tmp_path_factory.mktemp("pvs")
    store = made(folder, build={"limit": 0.0025, "max_inner": 8})
    found = measured(store)
    write_pvs_report(folder / "new" / "report", found, store, subject())
    return store, found, folder / "new" / "report"


def test_the_folder_holds_the_page_the_document_and_the_pictures(kept: tuple[VisibilityStore, Quality, Path]) -> None:
    folder = kept[2]
    assert {path.name for path in folder.iterdir()} == {
        "report.html", "report.json", "timings.json", *(f"{name}.png" for name in PICTURES)
    }  # fmt: skip
    for path in folder.glob("*.png"):
        with Image.open(path) as image:
            image.load()
            assert image.getextrema() != ((0, 0),) * 3
            assert not path.name.startswith("worst") or image.size == (QUICK.width, QUICK.height)


def test_the_document_holds_every_figure(kept: tuple[VisibilityStore, Quality, Path]) -> None:
    store, found, folder = kept
    document = json.loads((folder / "report.json").read_text(encoding="utf-8"))
    assert document == json.loads(json.dumps(pvs_document(found, store, subject())))
    assert (document["format"], document["version"]) == ("gsvis-pvs-report", 3)
    assert document["quality"] == json.loads(json.dumps(found.as_dict()))
    assert document["store"]["cells"]["visible"] == store.visible_counts.tolist()
    assert len(document["store"]["cells"]["centers"]) == len(store)
    bound = store.certificates.bound
    assert document["store"]["cells_above_limit"] == count_above_limit(store) == np.count_nonzero(bound > 0.0025) > 0
    assert document["store"]["certificates"] == store.certificates.as_dict()
    assert document["store"]["cells"]["bound"] == bound.tolist()
    assert document["store"]["cells"]["tile"] == store.certificates.tile.tolist()
    assert found.light is not None
    below = np.count_nonzero(found.light.missed_by_cell > bound[found.cells])
    assert document["bounds_checked"] == {"cells": len(found), "below_estimate": below}
    assert below > 0  # the certificates of this store are made up: each set misses a tenth of the scene
    assert document["store"]["cells"]["inner_viewpoints"] == store.certificates.inner.tolist()


def test_the_page_is_whole_and_needs_nothing_else(kept: tuple[VisibilityStore, Quality, Path]) -> None:
    html = (kept[2] / "report.html").read_text(encoding="utf-8")
    outline = Outline(html)
    assert outline.open == []
    assert all(link.startswith("data:image/png;base64,") for link in outline.links)
    assert not {"script", "iframe", "link"} & set(outline.tags)
    assert re.search(r'name="viewport"', html)
    assert "prefers-color-scheme: dark" in html
    assert outline.tags.count("figure") == len(outline.alternatives) == len(PICTURES)
    assert all(outline.alternatives)
    assert outline.tags.count("source") == len(PICTURES) - 3  # plots are drawn for dark pages, too


def test_names_from_outside_are_text_not_markup(kept: tuple[VisibilityStore, Quality, Path]) -> None:
    outline = Outline((kept[2] / "report.html").read_text(encoding="utf-8"))
    text = "".join(outline.words)
    assert AWKWARD in text
    assert "gsvis <x> & y" in text
    assert "a<b" in text
    assert "b" not in outline.tags


def test_figures_stand_beside_their_targets_and_worst_cells_have_places(
    kept: tuple[VisibilityStore, Quality, Path],
) -> None:
    store, found, folder = kept
    text = "".join(Outline((folder / "report.html").read_text(encoding="utf-8")).words)
    for target in ("at least 99.9%", "at least 99.5%", "at least 45 dB", "at least 40 dB", "at most 1.3"):
        assert target in text
    worst = int(found.cells[found.worst()[0]])
    x, y, z = store.grid.centers[worst]
    assert f"cell {worst}{x:.2f}, {y:.2f}, {z:.2f}" in text
    assert "92 bytes a Gaussian" in text
    assert f"{count_above_limit(store)} cells stayed above the limit" in text
    assert "inner ones are added where the rays of a certificate ask for them" in " ".join(text.split())
    assert f"{int(store.certificates.rays.sum()):,} fresh rays prove" in text
    assert "16 x 16 pixels" in text
    assert "The worst tile of 16 x 16 pixels misses 2.0% of its light on average" in " ".join(text.split())
    assert "below the estimate by fresh rays in" in " ".join(text.split())
    for label in ("light that the set keeps, 16 px", "visible Gaussians that it has, 16 px"):
        assert label in text
    assert "300 random rays" in text
    assert "at most 0.05%" in text
    assert "at most 0.15%" in text


def test_a_report_is_the_same_every_time(kept: tuple[VisibilityStore, Quality, Path], tmp_path: Path) -> None:
    store, found, folder = kept
    write_pvs_report(tmp_path, found, store, subject())
    for path in folder.iterdir():
        assert path.read_bytes() == (tmp_path / path.name).read_bytes(), path.name


def test_one_cell_without_a_dense_union_and_without_a_known_build_still_makes_a_report(tmp_path: Path) -> None:
    with made(tmp_path, certified=False) as store:
        assert count_above_limit(store) == 0
        found = measured(store, QualityConfig(cells=1, viewpoints=1, size=8, dense=0, width=8, height=6))
        write_pvs_report(tmp_path / "out", found, store, subject())
    text = "".join(Outline((tmp_path / "out" / "report.html").read_text(encoding="utf-8")).words)
    assert json.loads((tmp_path / "out" / "report.json").read_text())["store"]["cells"]["bound"] == [None] * len(store)
    assert "dense union" not in text
    assert "This store has no certificates" in text
    assert "image from the set" in text


def test_the_second_tracer_is_named_with_what_it_found() -> None:
    found = {"rays": 16384, "error": 0.05, "missed": 0.0012, "bound": 0.0015, "heavy_rays": 0.02}
    assert "miss 0.120% of the light; with 95% confidence the sets miss at most 0.150%" in describe_certificate(
        {**found, "rays_traced_twice": 0}
    )
    assert "Open3D is not installed" in describe_certificate({**found, "rays_traced_twice": 0})
    agreed = {**found, "rays_traced_twice": 128, "rays_agreeing": 128, "largest_difference": 0.0}
    assert "agree on all of them" in describe_certificate(agreed)
    differing = {**agreed, "rays_agreeing": 125, "largest_difference": 0.25}
    assert "the tracers differ on 3, by at most 0.25 of a weight" in describe_certificate(differing)


def test_nothing_is_written_when_writing_is_interrupted(
    kept: tuple[VisibilityStore, Quality, Path], tmp_path: Path
) -> None:
    def stop(stage: str, done: int, total: int) -> None:
        if done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_pvs_report(tmp_path / "out", kept[1], kept[0], subject(), progress=stop)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("up", [(0, 0, 1), (0, -1, 0), (0.6, 0.0, 0.8)])
def test_cells_above_each_other_share_a_square_with_the_largest_value(up: tuple[float, float, float]) -> None:
    coords = np.array([[x, y, z] for x in range(2) for y in range(3) for z in range(2)], np.int32)
    grid = CellGrid(np.zeros(3), 2.0, (2, 3, 2), coords, np.array(up))
    values = np.arange(12.0)
    values[:2] = np.nan
    scene = two_rooms(1000, sh_degree=0).gaussians
    ground = Ground.from_scene(scene, up)
    squares, most = CellMap(grid, values, "value", 0.0, 1.0).columns(ground)
    if max(map(abs, up)) == 1:
        assert len(squares) == 12 // grid.shape[int(np.abs(up).argmax())]
    places, held = ground.project(grid.centers), 0
    for square, value in zip(squares, most, strict=True):
        assert np.ptp(square, axis=0) == pytest.approx([2.0, 2.0])
        inside = np.all(np.abs(places - square.mean(axis=0)) <= 1.0 + 1e-9, axis=1)
        held += int(inside.sum())
        known = values[inside][np.isfinite(values[inside])]
        assert value == known.max() if len(known) else np.isnan(value)
    assert held == 12  # each cell in one square
