"""The page of examples/viewer-three in Chromium: a stream of gsvis drawn by Spark among objects of three.js.

The packages are looked for where `tests.viewer.test_engine_pages` looks.
"""

from __future__ import annotations

import io
import shutil
import time
from pathlib import Path

import numpy as np
from PIL import Image

from gsvis.color.evaluate import Evaluator
from gsvis.package import Package
from gsvis.render import psnr, rasterize
from gsvis.scene.cameras import Cameras
from tests.serve.servers import PATIENCE, serving
from tests.stream.worlds import package_of
from tests.viewer.browser import browser_page, chromium, served, viewer_files
from tests.viewer.test_engine_pages import modules

EXAMPLE = Path(__file__).parents[2] / "examples" / "viewer-three"
SIZE = {"width": 320, "height": 240}


def test_the_page_draws_what_is_streamed(tmp_path: Path) -> None:
    viewer, _ = viewer_files(), chromium()
    found = modules("@sparkjsdev/spark", "three")
    site = tmp_path / "site"
    shutil.copytree(EXAMPLE, site / "examples" / "viewer-three", ignore=shutil.ignore_patterns("node_modules"))
    (site / "examples" / "viewer-three" / "node_modules").symlink_to(found)
    shutil.copytree(viewer, site / "gsvis" / "viewer")
    with package_of(tmp_path / "scene.gsvis", 800) as package:
        eye = package.visibility.grid.centers[0]
        target = package.contents.gaussians().means.mean(axis=0)
        wanted = picture(package, eye, target)
    with served(site) as address, serving(tmp_path / "scene.gsvis", origins=(address,)) as server:
        asked = f"stream={server.url}&eye={spell(eye)}&target={spell(target)}"
        with browser_page(f"{address}/examples/viewer-three/index.html?{asked}", viewport=SIZE) as (page, said):
            best, end = 0.0, time.monotonic() + PATIENCE
            while best < 25.0 and time.monotonic() < end:
                page.wait_for_timeout(500)
                shot = np.asarray(Image.open(io.BytesIO(page.screenshot())).convert("RGB"), np.float64) / 255.0
                best = float(psnr(shot[:200], wanted[:200]))  # above the line of text
            assert best > 25.0
            assert said == []


def spell(point: np.ndarray) -> str:
    return ",".join(repr(float(v)) for v in point)


def picture(package: Package, eye: np.ndarray, target: np.ndarray) -> np.ndarray:
    """The highest level with all terms; splats of Spark are not quite ours."""
    contents = package.contents
    g, top = contents.gaussians(), contents.last == len(contents.names) - 1
    across = 2 * np.degrees(np.arctan(np.tan(np.radians(30.0)) * SIZE["width"] / SIZE["height"]))
    camera = Cameras.look_at([eye], [target], up=package.manifest.info.up, fov=across, **SIZE)
    colors = Evaluator(contents.colors().dequantize()).colors(g.means, eye)[top]
    return np.clip(rasterize(g[top], camera, colors=colors).images[0], 0.0, 1.0)
