"""The viewer's canvas in Chromium without a GPU against `rasterize`: PSNR for known cameras, and what it survives."""

from __future__ import annotations

import base64
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from gsvis.color.records import quantize
from gsvis.package import in_package_order
from gsvis.package.contents import Contents
from gsvis.render import rasterize
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.levels import Levels
from gsvis.scene.procedural import two_rooms
from gsvis.scene.sh import SH_C0
from tests.color.samples import random_colors
from tests.package.worlds import on_lattice
from tests.viewer.batches import Batches, camera_dicts
from tests.viewer.browser import page_in, served, viewer_files

F32 = NDArray[np.float32]
COUNT, WIDTH, HEIGHT = 12_000, 240, 160
EYES = ((0.8, 2.0, 1.6), (2.4, 0.8, 1.2), (5.6, 2.2, 1.5))
TARGETS = ((6.0, 2.3, 1.2), (2.2, 3.1, 0.7), (1.0, 1.0, 1.0))
PAGES = Path(__file__).parent / "pages"


def scene_of(sh_degree: int = 0, *, lattice: bool = False) -> Levels:
    """Two rooms in the order of a package: every second Gaussian is of the lower level too."""
    g = two_rooms(COUNT, sh_degree=sh_degree).gaussians
    g = on_lattice(g) if lattice else g
    first = (np.arange(len(g)) % 2).astype(np.uint8)
    return in_package_order(Levels(g, first, np.ones(len(g), np.uint8), ("low", "high")))


def contents_of(levels: Levels, variant: str, most_terms: int) -> Contents:
    colors = random_colors(np.random.default_rng(3), len(levels.union), variant, most_terms)
    return Contents.from_levels(levels, quantize(colors, "wire", refit=False))


def harmonics_of(g: Gaussians) -> tuple[dict[str, Any], NDArray[np.uint8], F32]:
    """Tables, (N, 3 K) bytes, and the coefficients that they stand for."""
    high = np.abs(g.shN).max(axis=(0, 2))
    low = -high * (128.0 / 127.0)
    places = np.clip(np.rint((g.shN - low[:, None]) / (high - low)[:, None] * 255.0), 0, 255).astype(np.uint8)
    table = {"degree": g.sh_degree, "low": low.tolist(), "high": high.tolist(), "sets": len(g)}
    exact = low[:, None] + places / 255.0 * (high - low)[:, None]
    return table, places.reshape(len(g), -1), exact.astype(np.float32)


@pytest.fixture(scope="module")
def cameras() -> Cameras:
    return Cameras.look_at(EYES, TARGETS, up=(0, 0, 1), width=WIDTH, height=HEIGHT, fov=75.0)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The page, the viewer, and one folder of batches for each kind of scene."""
    root = tmp_path_factory.mktemp("viewer")
    for path in [*PAGES.iterdir(), *viewer_files().glob("*.js")]:
        shutil.copy(path, root)
    for name, variant, most in (("flat", "rgb", 0), ("terms", "rgb", 5), ("hsl", "hsl", 3), ("lattice", "rgb", 5)):
        contents = contents_of(scene_of(lattice=name == "lattice"), variant, most)
        assert contents.table.logarithmic.any() == (name == "lattice")
        batches = Batches(contents)
        for part in np.array_split(np.arange(len(contents)), 5):
            batches.add(part)
        batches.save(root / name)
    bare = scene_of(3)
    table, places, _ = harmonics_of(bare.union)
    batches = Batches(contents_of(bare, "rgb", 0), (table, places))
    batches.add(np.arange(len(bare.union)))
    batches.save(root / "bare")
    return root


@pytest.fixture(scope="module")
def opened(browser: Any, folder: Path) -> Iterator[Any]:
    with served(folder) as address, page_in(browser, f"{address}/picture.html") as (page, said):
        page.wait_for_function("() => window.ready")
        yield page
        assert said == []


def pixels(text: str, *, upward: bool) -> F32:
    """(H, W, 3) in [0, 1] from what the page gives."""
    rows = np.frombuffer(base64.b64decode(text), np.uint8).reshape(HEIGHT, WIDTH, 4)[:, :, :3]
    return (rows[::-1] if upward else rows).astype(np.float32) / 255.0


def psnr(image: F32, truth: F32) -> float:
    return float(-10.0 * np.log10(np.mean((image - np.clip(truth, 0.0, 1.0)) ** 2, dtype=np.float64)))


def truths(name: str, cameras: Cameras) -> F32:
    if name == "bare":
        levels = scene_of(3)
        made = contents_of(levels, "rgb", 0).gaussians()
        g = Gaussians(made.means, made.quats, made.scales, made.opacities, made.sh0, harmonics_of(levels.union)[2])
        return rasterize(g, cameras).images
    kinds = {"flat": ("rgb", 0), "terms": ("rgb", 5), "hsl": ("hsl", 3), "lattice": ("rgb", 5)}
    made_ = contents_of(scene_of(lattice=name == "lattice"), *kinds[name])
    return rasterize(made_.gaussians(), cameras, colors=made_.colors().dequantize()).images


def canvases(page: Any, cameras: Cameras) -> list[F32]:
    return [
        pixels(page.evaluate("lens => test.canvasBytes(lens)", lens), upward=True) for lens in camera_dicts(cameras)
    ]


@pytest.mark.parametrize(
    ("name", "precision", "least"),
    [
        ("flat", "float", 50.0), ("flat", "half", 50.0), ("flat", "bytes", 45.0),
        ("terms", "half", 42.0), ("terms", "bytes", 36.0),
        ("hsl", "half", 42.0), ("lattice", "half", 42.0), ("bare", "half", 42.0),
    ],
)  # fmt: skip
def test_the_canvas_shows_what_the_rasterizer_draws(
    opened: Any, cameras: Cameras, name: str, precision: str, least: float
) -> None:
    opened.evaluate("([name, precision]) => test.open(name, { precision })", [name, precision])
    found = [psnr(*pair) for pair in zip(canvases(opened, cameras), truths(name, cameras), strict=True)]
    print(name, precision, [round(value, 1) for value in found])  # noqa: T201  shown with -s
    assert opened.evaluate("test.viewer.statistics.precision") == precision
    assert min(found) >= least


def test_a_capture_is_what_the_canvas_shows(opened: Any, cameras: Cameras) -> None:
    opened.evaluate("test.open('terms')")
    lens = camera_dicts(cameras)[1]
    shown = pixels(opened.evaluate("lens => test.canvasBytes(lens)", lens), upward=True)
    assert np.array_equal(pixels(opened.evaluate("lens => test.capture(lens)", lens), upward=False), shown)


def test_terms_can_be_hidden(opened: Any, cameras: Cameras) -> None:
    opened.evaluate("test.open('terms')")
    opened.evaluate("test.viewer.termsShown = false")
    base = rasterize(contents_of(scene_of(), "rgb", 5).gaussians(), cameras).images
    assert min(psnr(*pair) for pair in zip(canvases(opened, cameras), base, strict=True)) >= 50.0


def test_levels_can_be_hidden(opened: Any, cameras: Cameras) -> None:
    opened.evaluate("test.open('flat')")
    made = contents_of(scene_of(), "rgb", 0)
    low = rasterize(made.gaussians(np.flatnonzero(made.first == 0)), cameras).images
    for shown, truth in (([False, True], rasterize(made.gaussians(), cameras).images), ([True, False], low)):
        opened.evaluate("shown => { test.viewer.levelsShown = shown; }", shown)
        assert min(psnr(*pair) for pair in zip(canvases(opened, cameras), truth, strict=True)) >= 50.0


def test_what_is_replaced_is_not_drawn(folder: Path, opened: Any, cameras: Cameras) -> None:
    made = contents_of(scene_of(), "rgb", 5)
    low, high = (np.flatnonzero(made.first == k) for k in (0, 1))
    batches = Batches(made)
    batches.add(low)
    batches.add(high, gone=low.tolist())
    batches.save(folder / "gone")
    opened.evaluate("test.open('gone')")
    truth = rasterize(made.gaussians(high), cameras, colors=made.colors().dequantize()[high]).images
    assert min(psnr(*pair) for pair in zip(canvases(opened, cameras), truth, strict=True)) >= 42.0
    assert opened.evaluate("test.viewer.statistics.drawn") <= len(high)


def test_a_lost_context_comes_back(opened: Any, cameras: Cameras) -> None:
    opened.evaluate("test.open('terms', {}, 3)")
    before = canvases(opened, cameras)[0]
    assert before.std() > 0.05
    opened.evaluate("test.loseContext()")
    opened.evaluate("[3, 4].map((k) => test.source.send(k)) && null")  # arrives while there is no GPU
    opened.evaluate("test.restoreContext()")
    assert min(psnr(*pair) for pair in zip(canvases(opened, cameras), truths("terms", cameras), strict=True)) >= 42.0


LOST_TWICE = """async () => {
    const lose = document.getElementById('canvas').getContext('webgl2').getExtension('WEBGL_lose_context');
    const event = (name) => new Promise((done) => test.viewer.addEventListener(name, done, { once: true }));
    for (const k of [2, 3]) {
        const [lost, back] = [event('contextlost'), event('contextrestored')];
        lose.loseContext();
        test.source.send(k);  // before the event
        await lost;
        await new Promise((done) => setTimeout(done));  // not within the event
        lose.restoreContext();
        await back;  // the GPU is being filled anew
    }
    test.source.send(4);
}"""


def test_what_arrives_while_the_context_is_lost_again_and_again_is_drawn(opened: Any, cameras: Cameras) -> None:
    opened.evaluate("test.open('terms', {}, 2)")
    canvases(opened, cameras)
    opened.evaluate(LOST_TWICE)
    assert min(psnr(*pair) for pair in zip(canvases(opened, cameras), truths("terms", cameras), strict=True)) >= 42.0
    assert opened.evaluate("test.viewer.statistics.gaussians") == len(scene_of().union)


def test_what_was_replaced_is_gone_from_the_gpu_after_a_lost_context(
    folder: Path, opened: Any, cameras: Cameras
) -> None:
    made = contents_of(scene_of(), "rgb", 5)
    low, high = (np.flatnonzero(made.first == k) for k in (0, 1))
    batches = Batches(made)
    batches.add(low)
    batches.add(high[::2], gone=low.tolist())
    batches.add(high[1::2])
    batches.save(folder / "renumbered")
    opened.evaluate("test.open('renumbered', {}, 2)")
    canvases(opened, cameras)
    opened.evaluate("test.loseContext()")
    opened.evaluate("test.restoreContext()")
    opened.evaluate("test.viewer.settled()")
    assert opened.evaluate("test.viewer.statistics.gaussians") == len(high[::2])
    opened.evaluate("test.source.send(2) && null")
    truth = rasterize(made.gaussians(high), cameras, colors=made.colors().dequantize()[high]).images
    assert min(psnr(*pair) for pair in zip(canvases(opened, cameras), truth, strict=True)) >= 42.0
    assert opened.evaluate("test.viewer.statistics.gaussians") == len(high)
    pick = opened.evaluate("test.viewer.pick(120, 80)")
    assert np.allclose(pick["position"], made.gaussians(np.array([pick["id"]])).means[0], atol=1e-5)


def test_a_small_memory_leaves_gaussians_out_and_says_so(opened: Any, cameras: Cameras) -> None:
    memory = 2_000_000
    opened.evaluate("memory => test.open('terms', { memory })", memory)
    shown = canvases(opened, cameras)[0]
    figures = opened.evaluate("test.viewer.statistics")
    assert 0 < figures["gaussians"] < COUNT
    assert 0 < figures["terms"] < contents_of(scene_of(), "rgb", 5).term_offsets[-1]
    assert figures["gaussians"] + figures["dropped"] == len(scene_of().union)
    assert memory / 2 < figures["gpuBytes"] <= memory
    assert shown.std() > 0.01
    (problem,) = opened.evaluate("window.problems")
    assert "left out" in problem


def test_a_pick_is_the_heaviest_gaussian_of_the_pixel(opened: Any, cameras: Cameras) -> None:
    opened.evaluate("test.open('terms')")
    made = contents_of(scene_of(), "rgb", 5)
    lens = camera_dicts(cameras)[0]
    opened.evaluate("lens => test.canvasBytes(lens)", lens)
    pick = opened.evaluate("test.viewer.pick(120, 80)")
    seen = made.gaussians(np.array([pick["id"]]))
    assert pick["slot"] == pick["id"]
    assert np.allclose(pick["position"], seen.means[0], atol=1e-5)
    assert pick["terms"] == made.term_counts[pick["id"]]
    one = Cameras(cameras.viewmats[:1], cameras.Ks[:1], WIDTH, HEIGHT)
    white = np.ones((len(made), 3), np.float32) * (np.arange(len(made)) == pick["id"])[:, None].astype(np.float32)
    weight = rasterize(made.gaussians(), one, colors=white).images[0, 80, 120, 0]
    assert pick["weight"] == pytest.approx(float(weight), abs=1e-4)


@pytest.mark.parametrize("paint", ["opacity", "level", "arrival", "terms", "depth"])
def test_every_paint_draws(opened: Any, cameras: Cameras, paint: str) -> None:
    opened.evaluate("test.open('terms')")
    opened.evaluate("paint => { test.viewer.paint = paint; }", paint)
    image = canvases(opened, cameras)[0]
    assert image.std() > 0.02


def test_marks_paint_each_gaussian_by_its_id(opened: Any, cameras: Cameras) -> None:
    opened.evaluate("test.open('terms', {}, 1)")
    marks = "Uint8Array.from({ length: 12000 }, (_, id) => (id % 2 ? 255 : 0))"
    opened.evaluate(f"test.viewer.marks = {{ weight: {marks} }}; test.viewer.paint = 'weight'")
    opened.evaluate("for (let k = 1; k < test.source.scene.batches.length; k++) test.source.send(k)")
    made = contents_of(scene_of(), "rgb", 5)
    low, high = np.array([0.13, 0.11, 0.36]), np.array([0.99, 0.91, 0.42])
    seen = np.where((np.arange(len(made)) % 2 == 1)[:, None], high, low).astype(np.float32)
    truth = np.clip(rasterize(made.gaussians(), cameras, colors=seen).images, 0.0, 1.0)
    for image, wanted in zip(canvases(opened, cameras), truth, strict=True):
        assert psnr(image, wanted) > 45.0


def test_the_source_gets_poses_and_views(opened: Any, cameras: Cameras) -> None:
    opened.evaluate("test.open('flat')")
    opened.evaluate("test.viewer.camera = { position: [1, 2, 1], rotation: [1, 0, 0, 0], fovY: 1 }")
    assert opened.evaluate("test.source.poses.at(-1).position") == [1, 2, 1]
    view = opened.evaluate("test.source.views.at(-1)")
    assert view["up"] == pytest.approx(np.tan(0.5))
    assert view["left"] == pytest.approx(1.5 * np.tan(0.5))


def test_a_bare_color_is_half_plus_the_constant_harmonic() -> None:
    made = contents_of(scene_of(), "rgb", 0)
    assert np.allclose(made.gaussians().sh0[:, 0] * SH_C0 + 0.5, made.colors().dequantize().base, atol=1e-6)
