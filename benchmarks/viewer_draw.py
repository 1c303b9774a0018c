"""How fast, and how true to `gsvis render`, does the viewer draw whole scenes without a GPU, beside its rivals?

All show the same Gaussians in the same Chromium, one after the other, while the camera turns to and fro.

Given: showroom LOD 3 (SH 0) and nika LOD 2 (its SH fitted with terms); SwiftShader; a file of PlayCanvas and a
    folder `node_modules` with three and Spark by option.
Measured: frames a second, seconds of all cores for a frame (which other programs on the machine disturb less), PSNR
    of a still picture, milliseconds for which 50,000 Gaussians, appended one batch after the other, hold the main
    thread at a time, waits for a core among them, bytes of JavaScript, its Workers' too, and array buffers after
    collection.
Defaults chosen on: showroom LOD 3.
"""

from __future__ import annotations

import argparse
import base64
import io
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from _cores import PageThread, core_seconds
from _harness import add_arguments, realdata, write_result

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from gsvis.color.evaluate import Evaluator  # noqa: E402
from gsvis.color.fit import FitConfig, fit_srbf  # noqa: E402
from gsvis.color.records import quantize  # noqa: E402
from gsvis.color.srbf import SrbfColors  # noqa: E402
from gsvis.io import load_scene, save_scene  # noqa: E402
from gsvis.package import in_package_order  # noqa: E402
from gsvis.package.contents import Contents  # noqa: E402
from gsvis.render import rasterize  # noqa: E402
from gsvis.scene.cameras import Cameras  # noqa: E402
from gsvis.scene.levels import Levels  # noqa: E402
from gsvis.scene.sh import SH_C0  # noqa: E402
from tests.viewer.batches import Batches, camera_dicts  # noqa: E402
from tests.viewer.browser import browser_page, served, viewer_files  # noqa: E402

SCENES: dict[str, tuple[str, int, tuple[float, ...], tuple[float, ...], tuple[float, ...]]] = {
    # name: file, LOD, eye, target, up
    "showroom": ("showroom/lod-meta.json", 3, (0.0, 0.0, 1.6), (5.0, 1.0, 1.2), (0.0, 0.0, 1.0)),
    "nika": ("nika_sh3/lod-meta.json", 2, (0.0, -1.0, -4.0), (0.0, -1.0, 2.0), (0.0, -1.0, 0.0)),
}
BATCH = 50_000
BLOCKS = """
const later = window.setTimeout;
let blocks = [];
window.setTimeout = (work, ...rest) => later(() => {
  const begin = performance.now();
  work();
  blocks.push(performance.now() - begin);
}, ...rest);
window.appendBatch = async (k) => {
  const wanted = test.viewer.statistics.gaussians + test.source.scene.batches[k].ids[2];
  blocks = [];
  const first = test.source.send(k);
  while (test.viewer.statistics.gaussians < wanted) await new Promise((done) => later(done, 1));
  return [first, ...blocks];
};
void 0; // a script that ends with a function would be called
"""


def main() -> None:
    parser = add_arguments(argparse.ArgumentParser(description=__doc__))
    parser.add_argument("--scenes", nargs="+", choices=SCENES, default=list(SCENES))
    parser.add_argument("--size", type=int, nargs=2, default=[960, 540])
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--precision", choices=("float", "half", "bytes"), help="default: what the page chooses")
    parser.add_argument("--playcanvas", type=Path, help="playcanvas.mjs; not compared without it")
    parser.add_argument(
        "--spark", type=Path, help="node_modules with three and @sparkjsdev/spark; not compared without"
    )
    parser.add_argument("--keep", type=Path, help="folder for pictures and scenes, used again where it has them")
    options = parser.parse_args()
    figures: list[dict[str, Any]] = []
    details: dict[str, Any] = {"size": options.size}
    with tempfile.TemporaryDirectory() as temporary:
        folder = options.keep or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        for source in (ROOT / "tests" / "viewer" / "pages", ROOT / "benchmarks" / "_viewer", viewer_files()):
            for path in source.glob("*.[hj]*"):
                shutil.copy(path, folder)
        if options.playcanvas:
            shutil.copy(options.playcanvas, folder / "playcanvas.mjs")
        if options.spark:
            bundle_spark(options.spark.resolve(), folder.resolve() / "spark.mjs")
        for name in options.scenes:
            lens, truth = make_scene(folder, name, options.size)
            figures += measure(folder, name, lens, truth, options, details)
    write_result(options.out, (__doc__ or "").splitlines()[0], figures, details)


def make_scene(folder: Path, name: str, size: list[int]) -> tuple[dict[str, Any], np.ndarray]:
    """Write batches and a PLY of what they decode to; return the camera and the picture that it should show."""
    file, lod, eye, target, up = SCENES[name]
    cameras = Cameras.look_at([eye], [target], up=up, width=size[0], height=size[1], fov=75.0)
    saved = folder / f"{name}.{size[0]}.npy"
    if not saved.exists():
        levels = in_package_order(Levels.single(load_scene(realdata() / "scenes" / file, lod)))
        g = levels.union
        if g.sh_degree:
            colors = fit_srbf(g, None, FitConfig()).colors
        else:
            colors = SrbfColors.without_terms(np.maximum(0.5 + SH_C0 * g.sh0[:, 0], 0.0))
        made = Contents.from_levels(levels, quantize(colors))
        batches = Batches(made)
        for start in range(0, len(made), BATCH):
            batches.add(np.arange(start, min(start + BATCH, len(made))))
        batches.save(folder / name)
        drawn = made.gaussians()
        save_scene(drawn, folder / f"{name}.ply")
        seen = Evaluator(made.colors().dequantize()).colors(drawn.means, eye)
        np.save(saved, np.clip(rasterize(drawn, cameras, colors=seen).images[0], 0.0, 1.0))
    return camera_dicts(cameras)[0], np.load(saved)


def bundle_spark(modules: Path, out: Path) -> None:
    """Make one script of three and Spark, minified."""
    entry = out.with_suffix(".entry.js")
    entry.write_text("export * as THREE from 'three';\nexport { SparkRenderer, SplatMesh } from '@sparkjsdev/spark';\n")
    words = ["npx", "esbuild", str(entry), "--bundle", "--minify", "--format=esm", f"--outfile={out}"]
    environment = {**os.environ, "NODE_PATH": str(modules)}
    subprocess.run([*words, "--log-level=error"], cwd=ROOT / "viewer", env=environment, check=True)


def psnr(image: np.ndarray, truth: np.ndarray) -> float:
    return float(-10.0 * np.log10(np.mean((image - truth) ** 2, dtype=np.float64)))


def measure(
    folder: Path,
    name: str,
    lens: dict[str, Any],
    truth: np.ndarray,
    options: argparse.Namespace,
    details: dict[str, Any],
) -> list[dict[str, Any]]:
    figures: list[dict[str, Any]] = []

    def add(what: str, reached: float, unit: str, better: str, target: float | None = None) -> None:
        figures.append(
            {"name": f"{name}: {what}", "target": target, "reached": reached, "unit": unit, "better": better}
        )

    with served(folder) as address:
        with browser_page(f"{address}/picture.html") as (page, said):
            page.wait_for_function("() => window.ready")
            appended = page.evaluate("([name, precision]) => test.open(name, { precision })", [name, options.precision])
            shape = (lens["height"], lens["width"], 4)
            data = base64.b64decode(page.evaluate("lens => test.canvasBytes(lens)", lens))
            image = np.frombuffer(data, np.uint8).reshape(shape)[::-1, :, :3] / 255.0
            save_png(folder / f"{name}-viewer.png", image)
            spun = spin(page, lens, options.seconds)
            heap = heap_bytes(page)
            single = append(page, name, options.precision)
            details[name] = {"statistics": spun, "append ms": appended, "append one by one": single, "heap": heap,
                             "console": said}  # fmt: skip
        terms = name != "showroom"
        least = (36.0 if terms else 45.0) if options.precision == "bytes" else 42.0 if terms else 50.0
        add("PSNR", psnr(image, truth), "dB", "higher", least)
        add("frames a second", spun["fps"], "1/s", "higher")
        add("cores' seconds a frame", spun["core seconds"], "s", "lower")
        blocks = [max(one["blocks"]) for one in single]
        add("append 50,000, longest block", max(blocks), "ms", "lower", 20.0)
        add("append 50,000, longest block, median of batches", float(np.median(blocks)), "ms", "lower")
        add(
            "append 50,000, all blocks, median", float(np.median([sum(one["blocks"]) for one in single])), "ms", "lower"
        )
        add("heap", sum(heap.values()) / 1e6, "MB", "lower", 40.0)
        for rival, page_name in (("PlayCanvas", "playcanvas"), ("Spark", "spark")):
            if not getattr(options, page_name):
                continue
            with browser_page(f"{address}/{page_name}.html") as (page, said):
                page.set_default_timeout(240_000)
                page.wait_for_function("() => window.ready")
                page.evaluate("([url, lens]) => test.open(url, lens)", [f"{name}.ply", lens])
                picture = page.evaluate("lens => test.picture(lens)", lens)
                other = spin(page, lens, options.seconds)
                details[name][page_name] = {**other, "console": said}
            image = load_png(base64.b64decode(picture.split(",")[1]))
            save_png(folder / f"{name}-{page_name}.png", image)
            add(f"{rival} PSNR", psnr(image, truth), "dB", "higher")
            add(f"{rival} frames a second", other["fps"], "1/s", "higher")
            add(f"{rival} cores' seconds a frame", other["core seconds"], "s", "lower")
            own = "PlayCanvas'" if rival == "PlayCanvas" else "Spark's"
            goal = 2.0 if rival == "PlayCanvas" else None
            add(f"{own} cores' seconds over ours", other["core seconds"] / spun["core seconds"], "", "higher", goal)
            add(f"frames a second over {own}", spun["fps"] / other["fps"], "", "higher", goal)
    return figures


def spin(page: Any, lens: dict[str, Any], seconds: float) -> dict[str, Any]:
    """Turn the camera; frames a second, and seconds of all cores that the browser spent on each."""
    before = core_seconds()
    spun: dict[str, Any] = page.evaluate("([lens, seconds]) => test.spin(lens, seconds)", [lens, seconds])
    return {**spun, "core seconds": (core_seconds() - before) / max(spun["frames shown"], 1)}


def append(page: Any, name: str, precision: str | None) -> list[dict[str, Any]]:
    """Append batches one by one; milliseconds of each block of the main thread, of all on a core and without."""
    thread, spent = PageThread(page), []
    page.evaluate(BLOCKS)
    page.evaluate("([name, precision]) => test.open(name, { precision }, 0)", [name, precision])
    for k in range(int(page.evaluate("test.source.scene.batches.length"))):
        before = thread.spent()
        blocks = page.evaluate("k => window.appendBatch(k)", k)
        ran, waited = thread.spent().since(before)
        spent.append({"blocks": blocks, "ran": ran, "waited": waited})
    return spent


def heap_bytes(page: Any) -> dict[str, float]:
    """Bytes of the page and its Workers, by kind; without the recorded batches."""
    page.evaluate("test.source.data = null; test.source.scene = null")
    measured = page.evaluate("performance.measureUserAgentSpecificMemory()")
    kinds: dict[str, float] = {}
    for part in measured["breakdown"]:
        scopes = "+".join(sorted({place["scope"] for place in part["attribution"]})) or "shared"
        kind = f"{scopes}: {'+'.join(part['types']) or 'other'}"
        kinds[kind] = kinds.get(kind, 0.0) + part["bytes"]
    return {kind: size for kind, size in kinds.items() if size}


def save_png(path: Path, image: np.ndarray) -> None:
    from PIL import Image

    Image.fromarray(np.rint(image * 255.0).astype(np.uint8)).save(path)


def load_png(data: bytes) -> np.ndarray:
    from PIL import Image

    return np.asarray(Image.open(io.BytesIO(data)).convert("RGB"), np.float64) / 255.0


if __name__ == "__main__":
    main()
