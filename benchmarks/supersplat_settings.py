"""Does the same settings.json look the same on our page and in SuperSplat's viewer?

One scene lies as a PLY beside SuperSplat's own viewer (npm) and as a static site of gsvis. Both open the same
settings.json: first camera, its angle, and the background. Windows are wide and tall, because an angle covers the
longer side. Both draw in the same Chromium, without a GPU; pictures have no controls on them. Renderers differ, so
`gsvis render` also draws each view 1% narrower and wider: a parabola through the three errors says at which angle it
comes nearest to SuperSplat's picture.

Given: nika LOD 2 (46,708 Gaussians, SH degree 3) and a guitar (90,854, SH 0); five views of each, drawn by --seed:
    eyes, angles from 35 to 90 degrees, backgrounds; --viewer, the folder `public` of @playcanvas/supersplat-viewer.
Measured: PSNR of our picture against that of SuperSplat's viewer, and of both against `gsvis render`; the nearest
    tangent of half the angle, over that of the settings.
Defaults chosen on: nothing was chosen by this benchmark.
"""

from __future__ import annotations

import argparse
import io
import json
import shutil
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from _harness import add_arguments, need, realdata, write_result
from PIL import Image

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from gsvis.export import StaticOptions, write_site  # noqa: E402
from gsvis.io import load_scene, save_scene  # noqa: E402
from gsvis.render import psnr, rasterize  # noqa: E402
from gsvis.scene.cameras import Cameras  # noqa: E402
from gsvis.scene.gaussians import Gaussians  # noqa: E402
from tests.viewer.browser import page_in, running, served  # noqa: E402

Vector = list[float]

# name: file, LOD, eye, target, up; eyes lie around this one
SCENES: dict[str, tuple[str, int | None, Vector, Vector, Vector]] = {
    "nika": ("nika_sh3/lod-meta.json", 2, [0.0, -1.0, -4.0], [0.0, -1.0, 2.0], [0.0, -1.0, 0.0]),
    "guitar": ("formats/guitar.compressed.ply", None, [0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, -1.0, 0.0]),
}
WINDOWS = ((640, 400), (400, 640))
WANTED = 32.0  # dB
BESIDE = (0.99, 1.01)  # of the tangent of half the angle
PATIENCE = 120.0  # seconds
VIEWS = 5


def main() -> None:
    parser = add_arguments(argparse.ArgumentParser(description=__doc__.splitlines()[0]))
    parser.add_argument("--viewer", type=Path, help="folder public of the npm package @playcanvas/supersplat-viewer")
    parser.add_argument("--scenes", nargs="+", choices=SCENES, default=list(SCENES))
    parser.add_argument("--seed", type=int, default=44)
    parser.add_argument("--keep", type=Path, help="folder for the pictures")
    options = parser.parse_args()
    need(options.viewer, "--viewer, the folder public of the npm package @playcanvas/supersplat-viewer")
    figures: list[dict[str, Any]] = []
    rows: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as made_in, running() as browser:
        for name in options.scenes:
            folder = Path(made_in) / name
            shutil.copytree(options.viewer, folder / "theirs")
            views = make_scene(folder, name, np.random.default_rng(options.seed))
            with served(folder) as address:
                found = [compare(browser, address, view, name, options.keep) for view in views]
            rows += found
            figures += figures_of(name, found)
            print(name, found, flush=True)
    write_result(options.out, __doc__.splitlines()[0], figures, {"views": rows})


def make_scene(folder: Path, name: str, rng: np.random.Generator) -> list[dict[str, Any]]:
    """Write a scene, its site and the settings of its views; return the views, with what `gsvis render` draws."""
    file, lod, eye, target, up = SCENES[name]
    g = load_scene(realdata() / "scenes" / file, lod) if lod is not None else load_scene(realdata() / "scenes" / file)
    save_scene(g, folder / "scene.ply")
    write_site(folder / "ours", g, StaticOptions(name=name, up=(up[0], up[1], up[2])))
    low, high = np.quantile(g.means, [0.05, 0.95], axis=0)
    middle = np.array(target) if any(eye) else 0.5 * (low + high)
    views = []
    for number in range(VIEWS):
        away = np.linalg.norm(high - low) * rng.uniform(0.8, 1.3)
        turn = rng.uniform(-np.pi, np.pi)
        around = middle + away * np.array([np.sin(turn), -0.2, -np.cos(turn)])
        near = np.array(eye) + rng.uniform(-1.0, 1.0, 3) * [2.0, 0.4, 1.0]
        view = {
            "scene": name,
            "number": number,
            "window": WINDOWS[number % 2],
            "eye": (near if any(eye) else around).tolist(),
            "target": middle.tolist(),
            "fov": float(rng.uniform(35.0, 90.0)),
            "background": rng.uniform(0.0, 1.0, 3).round(3).tolist(),
        }
        (folder / f"view{number}.json").write_text(json.dumps(settings_of(view)))
        view["render"], view["narrow"], view["wide"] = (draw(g, view, up, size) for size in (1.0, *BESIDE))
        views.append(view)
    return views


def settings_of(view: dict[str, Any]) -> dict[str, Any]:
    """Return a settings.json of version 2: its frame is the scene's, turned by 180 degrees around z."""
    turned = {key: [-view[key][0], -view[key][1], view[key][2]] for key in ("eye", "target")}
    pose = {"position": turned["eye"], "target": turned["target"], "fov": view["fov"]}
    off = {"enabled": False}
    effects = {
        "sharpness": {**off, "amount": 0},
        "bloom": {**off, "intensity": 1, "blurLevel": 2},
        "grading": {**off, "brightness": 0, "contrast": 1, "saturation": 1, "tint": [1, 1, 1]},
        "vignette": {**off, "intensity": 0.5, "inner": 0.3, "outer": 0.75, "curvature": 1},
        "fringing": {**off, "intensity": 0.5},
    }
    return {
        "version": 2,
        "tonemapping": "none",
        "highPrecisionRendering": False,
        "background": {"color": view["background"]},
        "postEffectSettings": effects,
        "animTracks": [],
        "cameras": [{"initial": pose}],
        "annotations": [],
        "startMode": "default",
    }


def draw(g: Gaussians, view: dict[str, Any], up: Vector, size: float) -> np.ndarray:
    """Return what `gsvis render` draws of a view, (H, W, 3), its angle `size` times as wide, over the longer side."""
    width, height = view["window"]
    longer = size * np.tan(np.radians(view["fov"]) / 2.0)
    across = longer if width > height else longer * width / height
    fov = float(np.degrees(2.0 * np.arctan(across)))
    camera = Cameras.look_at([view["eye"]], [view["target"]], up=up, width=width, height=height, fov=fov)
    drawn = rasterize(g, camera, background=view["background"])
    return np.clip(drawn.images[0], 0.0, 1.0)


def compare(browser: Any, address: str, view: dict[str, Any], name: str, keep: Path | None) -> dict[str, Any]:
    """Return the PSNR of both pages and of `gsvis render` by each other."""
    settings = f"{address}/view{view['number']}.json"
    ours = picture(browser, f"{address}/ours/index.html?noui&settings={settings}", view["window"])
    words = f"webgl&noui&noanim&content={address}/scene.ply&settings={settings}"
    theirs = picture(browser, f"{address}/theirs/index.html?{words}", view["window"])
    pictures = {"ours": ours, "theirs": theirs, "render": view["render"]}
    if keep is not None:
        keep.mkdir(parents=True, exist_ok=True)
        for who, image in pictures.items():
            pixels = np.rint(255.0 * image).astype(np.uint8)
            Image.fromarray(pixels).save(keep / f"{name}-{view['number']}-{who}.png")
    told = {key: view[key] for key in ("scene", "number", "window", "fov", "background")}
    return {
        **told,
        "ours_theirs": float(psnr(ours, theirs)),
        "ours_render": float(psnr(ours, view["render"])),
        "theirs_render": float(psnr(theirs, view["render"])),
        "angle": nearest_angle([view["narrow"], view["render"], view["wide"]], theirs),
    }


def nearest_angle(drawn: list[np.ndarray], wanted: np.ndarray) -> float:
    """Return where the parabola through the errors of three pictures is lowest, over the angle of the middle one."""
    low, middle, high = (float(np.square(image - wanted).mean()) for image in drawn)
    bend = low - 2.0 * middle + high
    return 1.0 + 0.5 * (BESIDE[1] - 1.0) * (low - high) / bend


def picture(browser: Any, address: str, window: tuple[int, int]) -> np.ndarray:
    """Return what a page shows when three looks in a row are the same and show something, (H, W, 3) in [0, 1]."""
    viewport = {"width": window[0], "height": window[1]}
    with page_in(browser, address, viewport=viewport, reduced_motion="reduce") as (page, said):
        before: list[bytes] = []
        end = time.monotonic() + PATIENCE
        while time.monotonic() < end:
            page.wait_for_timeout(1500)
            shot = page.screenshot()
            pixels = np.asarray(Image.open(io.BytesIO(shot)).convert("RGB"), np.float64) / 255.0
            before = [*before[-2:], pixels.tobytes()]
            if len(before) == 3 and len(set(before)) == 1 and np.ptp(pixels.reshape(-1, 3), axis=0).max() > 0.2:
                return pixels
    raise RuntimeError(f"{address}: no picture that stays; the page said {said[-3:]}")


def figures_of(name: str, rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the figures of one scene: the mean and the worst of its views."""
    labels = {
        "ours_theirs": ("our page against SuperSplat's viewer", WANTED),
        "ours_render": ("our page against gsvis render", None),
        "theirs_render": ("SuperSplat's viewer against gsvis render", None),
    }
    figures = []
    for key, (label, wanted) in labels.items():
        found = np.array([row[key] for row in rows])
        figures.append(
            {
                "name": f"{name}, {len(rows)} views: {label}, worst view", "target": wanted,
                "reached": float(found.min()), "unit": "dB", "better": "higher", "mean": float(found.mean()),
            }
        )  # fmt: skip
    away = 100.0 * np.abs(np.array([row["angle"] for row in rows]) - 1.0)
    figures.append(
        {
            "name": f"{name}, {len(rows)} views: how far the angle is from that of SuperSplat's viewer, worst view",
            "target": 0.5, "reached": float(away.max()), "unit": "%", "better": "lower", "mean": float(away.mean()),
        }
    )  # fmt: skip
    return figures


if __name__ == "__main__":
    main()
