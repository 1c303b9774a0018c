"""How many bytes does a Gaussian take, if records are rounded as coarsely as images keep 48 dB?

A scene is written as one level: with all bits, and rounded by `choose_limits` (`gsvis prepare --record-psnr`), with
colors as they were and with colors that are learned for rounded records. Bytes on disk are those of records, rows of
chunks and terms; on the wire those of records and terms, without ids and rows. The judge's eyes are anywhere, and those
of standing people, by other seeds and with other fields of view than in the choice.

Given: --scenes, by NAME:LOD, or files of scenes; --wanted dB; --mean-terms of fitted colors.
Measured: bytes a Gaussian on disk and on the wire; PSNR, mean and worst, of records against what was fitted, and
    against the scene (its spherical harmonics).
Defaults chosen on: nika LOD 1 (how many bits each kind of field lacks); nika LOD 2, flowers LOD 2 and a bonsai (rates
    of learning).
"""

from __future__ import annotations

import argparse
from typing import Any

import numpy as np
from _harness import add_arguments, realdata, write_result
from numpy.typing import NDArray
from record_parts import ROW_BYTES, SCENES, fitted

from gsvis.color import FitConfig, SrbfColors, quantize
from gsvis.color.evaluate import Evaluator
from gsvis.io import load_scene
from gsvis.package import Contents, PackageOrder, in_package_order
from gsvis.package.blocks import bytes_of_blocks
from gsvis.package.rounding import rounded_contents
from gsvis.prepare import PrepareConfig
from gsvis.prepare.record_limits import RecordLimits, cameras_of_choice, choose_limits
from gsvis.prepare.rounded_colors import RecordLesson
from gsvis.render import psnr, rasterize
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.levels import Levels
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.view_sampling import ViewSampling
from gsvis.stream.coding import Coding, Steps

JUDGES = {
    "anywhere": ViewSampling(12, 480, 360, 90.0, seed=77, stream=8),
    "standing": ViewSampling(12, 480, 360, 70.0, seed=78, stream=12, standing=1.0),
}
MOST = 16.0, 11.0  # bytes a Gaussian on disk that are wanted, with and without terms
ON_THE_WIRE = 10.0


def bytes_of(contents: Contents) -> dict[str, float]:
    """Return the bytes a Gaussian of records on disk and on the wire."""
    n = len(contents)
    steps = None if contents.limits is None else Steps.from_limits(contents.limits)
    records, term = Coding.from_contents(contents, steps).mean_bytes(contents)
    disk = (bytes_of_blocks(contents) + ROW_BYTES * len(contents.table)) / n
    return {"disk": disk, "wire": records + term * len(contents.term_records) / n, "wire records": records}


def drawn(g: Gaussians, colors: SrbfColors | None, cameras: Cameras) -> list[NDArray[np.float32]]:
    """Return images of Gaussians with colors, or with their spherical harmonics."""
    shown = None if colors is None else Evaluator(colors)
    found = []
    for c in range(len(cameras)):
        rgb = None if shown is None else shown.colors(g.means, cameras[c].viewpoints[0])
        found.append(np.clip(rasterize(g, cameras[c], colors=rgb).images[0], 0.0, 1.0))
    return found


def quality_of(images: list[NDArray[np.float32]], truth: list[NDArray[np.float32]]) -> tuple[float, float]:
    """Return mean and worst PSNR."""
    values = [min(100.0, float(psnr(a, b))) for a, b in zip(images, truth, strict=True)]
    return float(np.mean(values)), float(np.min(values))


def measure(scene: str, options: argparse.Namespace) -> list[dict[str, Any]]:
    """Return the rows of a scene: with all bits, and rounded."""
    name, _, lod = scene.partition(":")
    folder, up = SCENES.get(name, ("", None))
    path = realdata() / "scenes" / folder / "lod-meta.json" if lod else scene
    single = Levels.single(load_scene(path, lod=int(lod) if lod else None))
    space = NavigableSpace.from_scene(single.union, up=up)
    exact = fitted(single.union, space, options.mean_terms)[PackageOrder.from_levels(single).permutation]
    levels = in_package_order(single)
    packed = quantize(exact)
    choice = cameras_of_choice(levels, space, PrepareConfig.cost_views)
    lesson = RecordLesson.draw(levels, exact, packed, space)
    chosen = choose_limits(levels, exact, packed, choice, options.wanted)
    learned = choose_limits(levels, exact, packed, choice, options.wanted, lesson=lesson)
    judges = {rule: views.cameras(levels, space) for rule, views in JUDGES.items()}
    fit = {rule: drawn(levels.union, exact, cameras) for rule, cameras in judges.items()}
    source = {rule: drawn(levels.union, None, cameras) for rule, cameras in judges.items()}
    rows = []
    ways: dict[str, RecordLimits | None] = {"all bits": None, f"{options.wanted:g} dB": chosen}
    ways[f"{options.wanted:g} dB, learned"] = learned
    for way, each in ways.items():
        limits = None if each is None else each.limits
        colors = packed if each is None or each.colors is None else each.colors
        contents = rounded_contents(levels, colors, limits)
        row: dict[str, Any] = {"scene": scene.rsplit("/", 1)[-1], "way": way, "gaussians": len(contents)}
        row |= {"terms_each": len(contents.term_records) / len(contents), **bytes_of(contents)}
        for rule, cameras in judges.items():
            images = drawn(contents.gaussians(), contents.colors().dequantize(), cameras)
            row[f"{rule}: psnr"], row[f"{rule}: worst"] = quality_of(images, fit[rule])
            row[f"{rule}: psnr of the scene"], _ = quality_of(images, source[rule])
        row["limits"] = None if limits is None else limits._asdict()
        print(row, flush=True)
        rows.append(row)
    return rows


def figures_of(row: dict[str, Any], options: argparse.Namespace) -> list[dict[str, Any]]:
    """Return the figures of a row; those of rounded records have targets."""
    rounded = row["way"] != "all bits"
    most = MOST[0] if row["terms_each"] else MOST[1]
    wanted = options.wanted if rounded else None
    label = f"{row['scene']}, {row['way']}"
    found = [
        (f"{label}: on disk", most if rounded else None, row["disk"], "bytes a Gaussian", "lower"),
        (f"{label}: on the wire", ON_THE_WIRE if rounded else None, row["wire"], "bytes a Gaussian", "lower"),
    ]
    for rule in JUDGES:
        found += [
            (f"{label}, {rule}: against what was fitted", wanted, row[f"{rule}: psnr"], "dB", "higher"),
            (f"{label}, {rule}: the worst view", None, row[f"{rule}: worst"], "dB", "higher"),
            (f"{label}, {rule}: against the scene", None, row[f"{rule}: psnr of the scene"], "dB", "higher"),
        ]
    return [{"name": n, "target": t, "reached": float(v), "unit": u, "better": b} for n, t, v, u, b in found]


def main() -> None:
    parser = add_arguments(argparse.ArgumentParser(description=__doc__))
    parser.add_argument("--scenes", nargs="+", default=["nika:1", "showroom:3", "flowers:1"], metavar="NAME:LOD")
    parser.add_argument("--wanted", type=float, default=48.0, metavar="DB")
    parser.add_argument("--mean-terms", type=float, default=FitConfig.mean_terms)
    options = parser.parse_args()
    rows = [row for scene in options.scenes for row in measure(scene, options)]
    figures = [figure for row in rows for figure in figures_of(row, options)]
    question = "How many bytes does a Gaussian take, if records are rounded as coarsely as images keep a wanted PSNR?"
    write_result(options.out, question, figures, {"rows": rows})


if __name__ == "__main__":
    main()
