"""What does a budget of Gaussians in the viewer cost in quality, and what does it save, beside plain choices?

Given: showroom LOD 2 (1.5 million Gaussians, no walls hidden by sets) and eyes that chose nothing (seed 977), standing,
    with more Gaussians in the picture than the largest budget.
Measured: PSNR of the viewer's picture with a budget against its picture without; the same for the nearest Gaussians and
    for random ones, as many, drawn by `rasterize`; seconds of all cores for a frame of a turning camera; milliseconds
    of a sort in its Worker.
Defaults chosen on: five eyes of seed 31 in the same scene (sizes of tiles). The first of the eyes here showed a fault
    at the border of the picture, which was mended.
"""

from __future__ import annotations

import argparse
import base64
import shutil
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from _harness import add_arguments, realdata, write_result
from numpy.typing import NDArray

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from _level_views import standing_cameras  # noqa: E402
from viewer_draw import BATCH, psnr, save_png, spin  # noqa: E402

from gsvis.color.records import quantize  # noqa: E402
from gsvis.color.srbf import SrbfColors  # noqa: E402
from gsvis.io import load_scene  # noqa: E402
from gsvis.package import in_package_order  # noqa: E402
from gsvis.package.contents import Contents  # noqa: E402
from gsvis.render import rasterize  # noqa: E402
from gsvis.scene.cameras import Cameras  # noqa: E402
from gsvis.scene.gaussians import Gaussians  # noqa: E402
from gsvis.scene.levels import Levels  # noqa: E402
from gsvis.scene.navigable import NavigableSpace  # noqa: E402
from gsvis.scene.sh import SH_C0  # noqa: E402
from tests.viewer.batches import Batches, camera_dicts  # noqa: E402
from tests.viewer.browser import browser_page, served, viewer_files  # noqa: E402

SCENE = "scenes/showroom/lod-meta.json"
SEED = 977
FOV = 75.0
SPUN = 2  # eyes at which frames are measured


def main() -> None:
    parser = add_arguments(argparse.ArgumentParser(description=__doc__))
    parser.add_argument("--eyes", type=int, default=4)
    parser.add_argument("--budgets", type=int, nargs="+", default=[250_000, 500_000])
    parser.add_argument("--size", type=int, nargs=2, default=[960, 540])
    parser.add_argument("--seconds", type=float, default=8.0)
    parser.add_argument("--keep", type=Path, help="folder for pictures and the scene, used again where it has them")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = options.keep or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        for source in (ROOT / "tests" / "viewer" / "pages", viewer_files()):
            for path in source.glob("*.[hj]*"):
                shutil.copy(path, folder)
        rows = measure(folder, write_scene(folder), options)
    write_result(options.out, (__doc__ or "").splitlines()[0], figures_of(rows, options.budgets), {"eyes": rows})


def write_scene(folder: Path) -> Gaussians:
    """Write the batches of the scene; return what they decode to."""
    levels = in_package_order(Levels.single(load_scene(realdata() / SCENE, 2)))
    colors = SrbfColors.without_terms(np.maximum(0.5 + SH_C0 * levels.union.sh0[:, 0], 0.0))
    made = Contents.from_levels(levels, quantize(colors))
    if not (folder / "scene").exists():
        batches = Batches(made)
        for start in range(0, len(made), BATCH):
            batches.add(np.arange(start, min(start + BATCH, len(made))))
        batches.save(folder / "scene")
    return made.gaussians()


def find_eyes(scene: Gaussians, options: argparse.Namespace) -> list[tuple[Cameras, NDArray[np.bool_]]]:
    """Return cameras with enough in the picture, and which Gaussians have their centers in it."""
    width, height = options.size
    focal = height / 2 / np.tan(np.radians(FOV) / 2)
    lens = np.array([[[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]]])
    space = NavigableSpace.from_scene(load_scene(realdata() / SCENE, 3), up="+z")
    found = []
    for view in standing_cameras(space, 8 * options.eyes, SEED).viewmats:
        x, y, z = (scene.means @ view[:3, :3].T + view[:3, 3]).T
        depth = np.maximum(z, 0.01)
        inside = (z > 0.01) & (np.abs(focal * x / depth) < width / 2) & (np.abs(focal * y / depth) < height / 2)
        if inside.sum() > 1.2 * max(options.budgets):
            found.append((Cameras(viewmats=view[None], Ks=lens, width=width, height=height), inside))
        if len(found) == options.eyes:
            break
    return found


def measure(folder: Path, scene: Gaussians, options: argparse.Namespace) -> list[dict[str, Any]]:
    """Return what was found at each eye."""
    rows: list[dict[str, Any]] = []
    rng = np.random.default_rng(SEED)
    with served(folder) as address, browser_page(f"{address}/picture.html") as (page, _):
        page.set_default_timeout(600_000)
        page.wait_for_function("() => window.ready")
        page.evaluate("test.open('scene')")
        for k, (cameras, inside) in enumerate(find_eyes(scene, options)):
            lens = camera_dicts(cameras)[0]
            row: dict[str, Any] = {"in the picture": int(inside.sum())}
            full = draw(page, lens, None)
            save_png(folder / f"{k}-full.png", full)
            if k < SPUN:
                row["full"] = spun(page, lens, options.seconds)
            truth = rasterize(scene, cameras).images[0].clip(0, 1)
            row["full against rasterize"] = psnr(full, truth)
            depths = (scene.means @ cameras.viewmats[0, 2, :3]) + cameras.viewmats[0, 2, 3]
            for budget in options.budgets:
                picture = draw(page, lens, budget)
                save_png(folder / f"{k}-{budget}.png", picture)
                own: dict[str, Any] = {"dB": psnr(picture, full)}
                if k < SPUN:
                    own.update(spun(page, lens, options.seconds))
                for name, order in (("nearest", depths), ("random", rng.random(len(depths)))):
                    last = np.partition(order[inside], budget)[budget]
                    kept = rasterize(scene[np.flatnonzero(~inside | (order < last))], cameras).images[0].clip(0, 1)
                    own[name] = psnr(kept, truth)
                row[str(budget)] = own
            print(row, flush=True)
            rows.append(row)
    return rows


def draw(page: Any, lens: dict[str, Any], budget: int | None) -> NDArray[np.float64]:
    """Return the picture of a lens with a budget."""
    page.evaluate("budget => { test.viewer.budget = budget ?? Infinity; }", budget)
    data = np.frombuffer(base64.b64decode(page.evaluate("lens => test.canvasBytes(lens)", lens)), np.uint8)
    return np.asarray(data.reshape(lens["height"], lens["width"], 4)[::-1, :, :3] / 255.0)


def spun(page: Any, lens: dict[str, Any], seconds: float) -> dict[str, float]:
    """Return what a turning camera takes."""
    found = spin(page, lens, seconds)
    return {"fps": found["fps"], "core seconds": found["core seconds"], "sort ms": found["sortMilliseconds"]}


def figures_of(rows: list[dict[str, Any]], budgets: list[int]) -> list[dict[str, Any]]:
    """Return the figures of all eyes."""
    figures: list[dict[str, Any]] = []

    def add(what: str, reached: float, unit: str) -> None:
        better = "lower" if unit in ("s", "ms") else "higher"
        figures.append({"name": what, "target": None, "reached": float(reached), "unit": unit, "better": better})

    moving = [row for row in rows if "full" in row]
    add("core seconds a frame, all Gaussians", np.median([row["full"]["core seconds"] for row in moving]), "s")
    for budget in budgets:
        all_ = [row[str(budget)] for row in rows]
        for name, key in (("budget", "dB"), ("nearest", "nearest"), ("random", "random")):
            add(f"{budget}: {name}, median of eyes", np.median([each[key] for each in all_]), "dB")
            add(f"{budget}: {name}, worst eye", min(each[key] for each in all_), "dB")
        spent = [row[str(budget)]["core seconds"] for row in moving]
        add(f"{budget}: core seconds a frame", np.median(spent), "s")
        gains = [row["full"]["core seconds"] / row[str(budget)]["core seconds"] for row in moving]
        add(f"{budget}: frames over those of all", np.median(gains), "")
    return figures


if __name__ == "__main__":
    main()
