"""How large is a static site of a bare scene with harmonics beside its SOG, and what does it lose?

Given: real scenes of SH degree 2 and 3.
Measured: bytes of all files of `gsvis.export.write_static`, over those of our SOG of the same Gaussians; PSNR of views
    against the scene, of harmonics alone (geometry and base colors as they were), for the site and for the SOG;
    processor time of the export.
Defaults chosen on: nothing; the number of sets is that of SOG.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from _harness import add_arguments, realdata, write_result

from gsvis.export import StaticOptions, write_static
from gsvis.export.harmonics import Harmonics, Palette
from gsvis.export.lights import areas_of
from gsvis.io import load_scene, save_scene
from gsvis.render import psnr, rasterize
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.view_sampling import ViewSampling

SCENES = {
    "nika": ("nika_sh3/lod-meta.json", 0),
    "nika, LOD 1": ("nika_sh3/lod-meta.json", 1),
    "flowers, LOD 1": ("flowers_sh2/lod-meta.json", 1),
    "flowers, LOD 2": ("flowers_sh2/lod-meta.json", 2),
}
VIEWS = ViewSampling(12, 480, 360, 75.0, 5, 3)
MOST = 1.1


def measure(name: str) -> dict[str, Any]:
    """Bytes and PSNR of one scene."""
    file, lod = SCENES[name]
    g = load_scene(realdata() / "scenes" / file, lod=lod)
    with tempfile.TemporaryDirectory() as made_in:
        begun = time.process_time()
        site = write_static(Path(made_in) / "site", g)
        seconds = time.process_time() - begun
        sog = Path(made_in) / "scene.sog"
        save_scene(g, sog)
        bytes_of_sog = os.path.getsize(sog)
        of_sog = load_scene(sog)  # in the same order
        exact = write_static(Path(made_in) / "exact", g, StaticOptions(most_sets=None))
    cameras = VIEWS.cameras(g, NavigableSpace.from_scene(g, up="-y"))
    target = rasterize(g, cameras).images.clip(0.0, 1.0)

    def quality(shN: np.ndarray) -> dict[str, float]:
        values = np.minimum(psnr(rasterize(replace(g, shN=shN), cameras).images.clip(0.0, 1.0), target), 100.0)
        return {"mean": float(values.mean()), "worst": float(values.min())}

    ranges = Harmonics.from_coefficients(g.shN, g.sh_degree)
    palette = Palette.from_scene(g.shN, areas_of(g) * g.opacities, ranges, StaticOptions().most_sets)
    return {
        "scene": name,
        "gaussians": len(g),
        "sh_degree": g.sh_degree,
        "sets": len(palette.sets),
        "bytes": site.nbytes,
        "bytes_of_sets": site.files["sets"].nbytes,
        "bytes_with_a_set_each": exact.nbytes,
        "bytes_of_sog": bytes_of_sog,
        "cpu_s": seconds,
        "psnr": quality(ranges.decode(palette.sets)[palette.labels]),
        "psnr_of_sog": quality(of_sog.shN),
    }


def main() -> None:
    parser = add_arguments(argparse.ArgumentParser(description=__doc__))
    parser.add_argument("--scenes", nargs="+", choices=SCENES, default=list(SCENES))
    arguments = parser.parse_args()
    rows = []
    for name in arguments.scenes:
        rows.append(measure(name))
        print(rows[-1], flush=True)
    figures = []
    for row in rows:
        ratio = row["bytes"] / row["bytes_of_sog"]
        name = f"{row['scene']}: bytes of the site over those of its SOG"
        figures.append({"name": name, "target": MOST, "reached": ratio, "unit": "times", "better": "lower"})
    question = "How large is a static site of a bare scene with harmonics beside its SOG, and what does it lose?"
    write_result(arguments.out, question, figures, {"rows": rows})


if __name__ == "__main__":
    main()
