"""The pages of examples/engines in Chromium, with the players from npm, and splat-transform on what they show.

The packages are looked for in examples/engines/node_modules, or where GSVIS_STREAMED_MODULES says.
"""

from __future__ import annotations

import io
import os
import shutil
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from gsvis.export import StreamedOptions, write_streamed_sog
from gsvis.io import load_scene
from gsvis.render import psnr, rasterize
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians
from tests.export.test_needs import store_of, two_heaps
from tests.package.worlds import levels_of
from tests.serve.servers import PATIENCE
from tests.viewer.browser import browser_page, chromium, served

EXAMPLE = Path(__file__).parents[2] / "examples" / "engines"
SIZE = {"width": 320, "height": 240}
LEFT, RIGHT = "eye=-1,0,0&target=-10,0,0", "eye=1,0,0&target=-10,0,0"


def modules(*packages: str) -> Path:
    folder = Path(os.environ.get("GSVIS_STREAMED_MODULES", EXAMPLE / "node_modules"))
    missing = [name for name in packages if not (folder / name / "package.json").is_file()]
    if missing:
        remedy = "run npm install in examples/engines; splat-transform needs @playcanvas/splat-transform@3.7 there"
        pytest.skip(f"no {missing[0]} in {folder}: {remedy}")
    return folder


def write_heaps(folder: Path, g: Gaussians) -> Path:
    """Write two heaps of 200; the cell on the left sees the left one alone, its neighbor both."""
    with (
        pytest.MonkeyPatch.context() as patch,
        store_of(folder / "s.pvs", g, [np.arange(200), np.arange(400)]) as store,
    ):
        patch.setattr("gsvis.export.streamed._SHARE", 1.0)  # cells of so small a scene stay apart
        write_streamed_sog(folder / "scene", g, StreamedOptions(leaf=200, name="Heaps"), visibility=store)
    return folder / "scene"


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_heaps(tmp_path_factory.mktemp("streamed"), two_heaps(200))


@contextmanager
def page_of(name: str, folder: Path, scene: Path, asked: str, *packages: str) -> Iterator[tuple[Any, list[str]]]:
    chromium()
    shutil.copytree(EXAMPLE, folder / "site", ignore=shutil.ignore_patterns("node_modules"))
    (folder / "site" / "node_modules").symlink_to(modules(*packages))
    shutil.copytree(scene, folder / "site" / "scene")
    with served(folder / "site") as address, browser_page(f"{address}/{name}?{asked}", viewport=SIZE) as found:
        yield found


PLAYERS = [
    ("playcanvas.html", ("playcanvas",)),
    ("spark.html", ("@sparkjsdev/spark", "three")),
    ("babylon.html", ("babylonjs", "babylonjs-loaders")),
    ("three.html", ("three",)),
]


@pytest.mark.parametrize(("name", "packages"), PLAYERS)
def test_a_page_draws_what_the_cell_needs(name: str, packages: tuple[str, ...], scene: Path, tmp_path: Path) -> None:
    with page_of(name, tmp_path, scene, LEFT, *packages) as (page, said):
        ready = "cell => globalThis.streamed?.complete && String(streamed.cell) === cell"
        page.wait_for_function(ready, arg="0,0,0", timeout=1000 * PATIENCE)
        state = page.evaluate("globalThis.streamed")
        assert (state["needed"], state["leaves"], state["drawn"], state["failed"]) == (1, 2, 200, [])
        assert state["held"] == 400  # what the neighbor needs has come too
        assert page.title().startswith("Heaps")
        wait_for_picture(page, scene)
        page.keyboard.down("KeyS")  # backwards, into the next cell
        page.wait_for_function(ready, arg="1,0,0", timeout=1000 * PATIENCE)
        page.keyboard.up("KeyS")
        assert page.evaluate("[streamed.needed, streamed.drawn]") == [2, 400]
        assert said == []


@pytest.mark.parametrize("degree", [1, 3])
def test_three_js_draws_colors_that_change_with_the_direction(degree: int, tmp_path: Path) -> None:
    heaps = two_heaps(200)
    bent = np.random.default_rng(degree).normal(0.0, 0.3, (len(heaps), (degree + 1) ** 2 - 1, 3))
    scene = write_heaps(tmp_path, replace(heaps, shN=bent.astype(np.float32)))
    with page_of("three.html", tmp_path, scene, LEFT, "three") as (page, said):
        wait_for_picture(page, scene)
        assert said == []


def test_a_budget_is_kept_and_the_brighter_leaf_is_drawn(scene: Path, tmp_path: Path) -> None:
    with page_of("playcanvas.html", tmp_path, scene, f"splats=250&{RIGHT}", "playcanvas") as (page, said):
        ready = "() => globalThis.streamed?.complete && streamed.drawn > 0"
        page.wait_for_function(ready, timeout=1000 * PATIENCE)
        state = page.evaluate("globalThis.streamed")
        assert (state["needed"], state["drawn"], state["failed"]) == (2, 200, [])
        assert sorted(state["lods"]) == [-1, 0]
        assert said == []


def wait_for_picture(page: Any, scene: Path) -> None:
    """Wait until the page shows the scene as `rasterize` draws it; splats of players are not quite ours."""
    across = 2 * np.degrees(np.arctan(np.tan(np.radians(30.0)) * SIZE["width"] / SIZE["height"]))
    camera = Cameras.look_at([[-1.0, 0, 0]], [[-10.0, 0, 0]], up=(0, 0, 1), fov=across, **SIZE)
    wanted = np.clip(rasterize(load_scene(scene / "lod-meta.json"), camera).images[0], 0.0, 1.0)
    rows = slice(0, 180)  # above the text
    found = 0.0
    end = time.monotonic() + PATIENCE
    while time.monotonic() < end:
        shot = np.asarray(Image.open(io.BytesIO(page.screenshot())).convert("RGB"), np.float64) / 255.0
        found = float(psnr(shot[rows], wanted[rows]))
        if found > 40.0:
            return
        page.wait_for_timeout(500)
    raise AssertionError(f"{found:.1f} dB")


def test_the_engine_alone_loads_everything_without_a_message(scene: Path, tmp_path: Path) -> None:
    with page_of("playcanvas.html", tmp_path, scene, f"plain=1&{RIGHT}", "playcanvas") as (page, said):
        page.wait_for_function("() => globalThis.app?.stats.frame.gsplats === 400", timeout=1000 * PATIENCE)
        assert said == []


def test_a_missing_sidecar_is_named(scene: Path, tmp_path: Path) -> None:
    shutil.copytree(scene, tmp_path / "cut")
    next((tmp_path / "cut").glob("leaves-*.bin")).unlink()
    with page_of("playcanvas.html", tmp_path, tmp_path / "cut", LEFT, "playcanvas") as (page, said):
        page.wait_for_function("() => document.querySelector('p').textContent.includes('404')", timeout=1000 * PATIENCE)
        assert any("404" in each for each in said)


def test_splat_transform_reads_the_same_numbers(tmp_path: Path) -> None:
    command = modules("@playcanvas/splat-transform") / "@playcanvas" / "splat-transform" / "bin" / "cli.mjs"
    node = shutil.which("node")
    if node is None:
        pytest.skip("no node: install Node.js 20 or later")
    write_streamed_sog(tmp_path / "s", levels_of(600), StreamedOptions(leaf=64))
    for lod in range(3):
        out = tmp_path / f"{lod}.ply"
        words = [node, command, "-q", "-g", "cpu", tmp_path / "s" / "lod-meta.json", "-L", str(lod), out]
        done = subprocess.run(words, capture_output=True, text=True, timeout=PATIENCE)
        assert done.returncode == 0, done.stderr
        ours, theirs = load_scene(tmp_path / "s" / "lod-meta.json", lod=lod), load_scene(out)
        ours = ours[: len(theirs)]  # without the environment
        assert np.array_equal(ours.means, theirs.means)
        assert np.abs(ours.opacities - theirs.opacities).max() < 2e-6
        assert np.allclose(ours.scales, theirs.scales, rtol=2e-6)
        assert np.array_equal(ours.sh0, theirs.sh0)
