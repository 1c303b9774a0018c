"""The report on colors: complete, self-contained, the same every time; and the spheres in it."""

from __future__ import annotations

import json
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from gsvis.color.epsilon import MetricObserver, calibrate_epsilon
from gsvis.color.fit import FitConfig
from gsvis.prepare.color_quality import ColorQualityConfig, measure_colors
from gsvis.prepare.colors import ColorConfig, prepare_colors
from gsvis.prepare.fitted_colors import FittedColors, round_colors
from gsvis.report import Subject
from gsvis.report.color_document import color_document, write_color_report
from gsvis.report.color_spheres import COUNTS, fit_spheres
from gsvis.scene.procedural import OccluderScene, two_rooms
from gsvis.scene.view_sampling import ViewSampling

pytestmark = pytest.mark.usefixtures("coarse_plots")
AWKWARD = "<b>\"rooms\" & 'halls'</b> $title"
PLOTS = {"bytes", "term_counts", "first_terms", "active", "active_psnr", "spheres"}
VIEWS = {f"{role}_{name}" for role in ("worst", "median") for name in ("sh", "srbf", "base", "difference")}


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


def subject(scene: OccluderScene) -> Subject:
    given = {"a<b": "<c>", "lod": None}
    return Subject(AWKWARD, scene.gaussians, scene.up, "anywhere", "gsvis <x> & y", "0", {}, given, {"fit": 1.0})


def made(scene: OccluderScene, max_terms: int = 3) -> FittedColors:
    g = scene.gaussians
    config = ColorConfig(FitConfig(max_terms=max_terms, mean_terms=1.0), ViewSampling(3, 48, 36), rays_per_face=0)
    found = prepare_colors(g, scene.navigable, config)
    colors = round_colors(found.fit.colors, "wire")
    views = ViewSampling(3, 48, 36, stream=1).cameras(g, scene.navigable)
    asked = ColorQualityConfig(counts=(1, 2), epsilons=(0.01, 0.1), flip=False)
    quality = measure_colors(g, colors, views, asked)
    calibration = calibrate_epsilon(MetricObserver(lambda epsilon: 5.0 * epsilon, threshold=0.1))
    epsilon = calibration.epsilon
    return FittedColors(g, colors, found, "wire", 123_456, epsilon, calibration, quality, np.array([0.25, 0.5]))


@pytest.fixture(scope="module")
def scene() -> OccluderScene:
    return two_rooms(1000, sh_degree=2)


@pytest.fixture(scope="module")
def kept(scene: OccluderScene, tmp_path_factory: pytest.TempPathFactory) -> tuple[FittedColors, Path]:
    folder, fitted = tmp_path_factory.mktemp("color") / "new" / "report", made(scene)
    write_color_report(folder, fitted, subject(scene))
    return fitted, folder


def test_the_folder_holds_the_page_the_document_and_the_pictures(kept: tuple[FittedColors, Path]) -> None:
    folder = kept[1]
    assert {path.name for path in folder.iterdir()} == {
        "report.html", "report.json", "timings.json", *(f"{name}.png" for name in PLOTS | VIEWS)
    }  # fmt: skip
    for path in folder.glob("*.png"):
        with Image.open(path) as image:
            image.load()
            assert image.getextrema() != ((0, 0),) * 3
            assert path.stem in PLOTS or image.size == (48, 36)


def test_the_document_holds_every_figure(kept: tuple[FittedColors, Path], scene: OccluderScene) -> None:
    fitted, folder = kept
    document = json.loads((folder / "report.json").read_text(encoding="utf-8"))
    assert document == json.loads(json.dumps(color_document(fitted, subject(scene))))
    assert (document["format"], document["version"]) == ("gsvis-color-report", 1)
    quality = document["quality"]
    assert [each["first"] for each in quality["by_count"]] == sorted({0, 1, 2, int(fitted.colors.counts.max())})
    assert quality["by_count"][0]["psnr"] == quality["base_only"]["psnr"]["mean"]
    assert quality["by_count"][-1]["psnr"] == quality["all_terms"]["psnr"]["mean"]
    assert quality["by_count"][-1]["mean_terms"] == pytest.approx(document["terms"]["mean"])
    shares = quality["visible_by_active"]["shares"]
    assert len(shares) == 6
    assert sum(shares) == pytest.approx(1.0)
    assert shares[0] < 1.0  # some terms are active
    worst = min(quality["cameras"], key=lambda row: row["psnr"])
    assert worst["role"] == "worst"
    assert document["epsilon"]["from"] == "calibrated"
    assert document["active_in_cells"]["share_of_all"] == {"mean": 0.375, "min": 0.25, "max": 0.5}


def test_the_page_is_whole_and_needs_nothing_else(kept: tuple[FittedColors, Path]) -> None:
    fitted, folder = kept
    outline = Outline((folder / "report.html").read_text(encoding="utf-8"))
    assert outline.open == []
    assert all(link.startswith("data:image/png;base64,") for link in outline.links)
    assert all(outline.alternatives)
    assert len(outline.alternatives) == len(PLOTS | VIEWS)
    assert not {"script", "b"} & set(outline.tags)  # the title's markup is text
    text = " ".join(" ".join(outline.words).split())
    for label in (AWKWARD, "gsvis <x> & y", f"{fitted.colors.num_terms:,}", "0.12 MB", "model observer"):
        assert label in text


def test_the_same_again_and_no_pictures_of_an_earlier_report(
    kept: tuple[FittedColors, Path], scene: OccluderScene, tmp_path: Path
) -> None:
    fitted, folder = kept
    (tmp_path / "median_sh.png").write_text("old")
    (tmp_path / "mine.txt").write_text("mine")
    assert fitted.quality is not None
    one = ViewSampling(1, 48, 36, stream=1).cameras(scene.gaussians, scene.navigable)
    quality = measure_colors(scene.gaussians, fitted.colors, one, ColorQualityConfig((1,), (0.01,), flip=False))
    write_color_report(tmp_path, replace(fitted, quality=quality, cell_shares=None), subject(scene))
    assert not (tmp_path / "median_sh.png").exists()
    assert (tmp_path / "mine.txt").read_text() == "mine"
    for name in ("term_counts", "bytes", "spheres"):
        assert (tmp_path / f"{name}.png").read_bytes() == (folder / f"{name}.png").read_bytes()


def test_colors_without_terms_have_a_report_too(tmp_path: Path) -> None:
    scene = two_rooms(1000, sh_degree=0)
    write_color_report(tmp_path, made(scene), subject(scene))
    assert not (tmp_path / "spheres.png").exists()
    outline = Outline((tmp_path / "report.html").read_text(encoding="utf-8"))
    assert outline.open == []
    assert "The colors have no terms." in " ".join(outline.words)


def test_a_report_needs_a_comparison(kept: tuple[FittedColors, Path], scene: OccluderScene, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="measure_colors"):
        write_color_report(tmp_path / "r", replace(kept[0], quality=None), subject(scene))
    assert not (tmp_path / "r").exists()


def test_spheres_come_closer_with_every_term(kept: tuple[FittedColors, Path]) -> None:
    spheres = fit_spheres(kept[0], 2)
    assert spheres.images.shape[:2] == (2, 2 + len(COUNTS))
    assert len(set(spheres.ids.tolist())) == 2
    assert (np.diff(spheres.errors, axis=1) <= 1e-9).all()
    base = spheres.images[:, 1]
    assert np.ptp(base, axis=(1, 2)).max() < 1e-6  # one color all over
    last = np.abs(spheres.images[:, -1] - spheres.images[:, 0]).max()
    assert last < 0.1 * np.abs(base - spheres.images[:, 0]).max()
