"""Of a package, how much is as it was after a small edit of the scene?

One scene a run, as one level, colors without view dependence, no visible sets. The edit: all Gaussians in a box around
the one in the middle, as large as takes 1% of them, are moved by a tenth of the box, made half as opaque, or deleted.
Counted are parts and bytes of the new package that stood in the old one under the same name, so that they are neither
written nor, by whoever has the old package, read again.

Given: a scene, an edit of 1% of it.
Measured: share of parts and bytes that stand as they were.
Defaults chosen on: nika and showroom, the scenes that are measured too.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np
from _harness import add_arguments, realdata, write_result

from gsvis.color import SrbfColors, quantize
from gsvis.io import load_scene
from gsvis.package import in_package_order, write_package
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.levels import Levels
from gsvis.scene.sh import SH_C0

SCENES = {"showroom": ("showroom", 3), "nika": ("nika_sh3", 0)}
SHARE = 0.01


def main() -> None:
    parser = add_arguments(argparse.ArgumentParser(description=__doc__))
    parser.add_argument("--scene", choices=tuple(SCENES), default="showroom")
    options = parser.parse_args()
    folder, lod = SCENES[options.scene]
    g = load_scene(realdata() / "scenes" / folder / "lod-meta.json", lod=lod)
    g = Gaussians(g.means, g.quats, g.scales, g.opacities, g.sh0)
    middle = g.means[np.argsort(np.abs(g.means - np.median(g.means, axis=0)).max(axis=1))[0]]
    distance = np.abs(g.means - middle).max(axis=1)
    side = 2.0 * float(np.quantile(distance, SHARE))
    inside = distance < side / 2.0
    arrays = (g.quats, g.scales)
    edits = {
        "moved": Gaussians(g.means + np.float32(0.1 * side) * inside[:, None], *arrays, g.opacities, g.sh0),
        "fainter": Gaussians(g.means, *arrays, g.opacities * np.where(inside, 0.5, 1.0), g.sh0),
        "deleted": g[~inside],
    }
    figures = []
    details = {"gaussians": len(g), "edited": int(inside.sum()), "box": side}
    for name, edited in edits.items():
        with tempfile.TemporaryDirectory() as place:
            before, after = written(Path(place) / "s.gsvis", g), written(Path(place) / "s.gsvis", edited)
        kept = {part: size for part, size in after.items() if part in before}
        details[name] = {"parts": len(after), "parts_kept": len(kept)}
        reached = 100.0 * sum(kept.values()) / sum(after.values())
        figures.append({"name": f"{options.scene}, {inside.mean():.1%} {name}: bytes of the package as they were",
                        "target": None, "reached": reached, "unit": "%", "better": "higher"})  # fmt: skip
    write_result(options.out, "Of a package, how much is as it was after a small edit?", figures, details)


def written(folder: Path, g: Gaussians) -> dict[str, int]:
    """Names and sizes of the parts of a package."""
    levels = in_package_order(Levels.single(g))
    colors = SrbfColors.without_terms(np.maximum(0.5 + SH_C0 * levels.union.sh0[:, 0], 0.0))
    with write_package(folder, levels, quantize(colors, "wire")) as package:
        return {part.name: part.nbytes for part in package.manifest.parts()}


if __name__ == "__main__":
    main()
