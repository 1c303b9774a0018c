"""What do SRBF colors cost on photographs, by variant (tables 2 and 3 of the paper), beside SH?

A bonsai trained by `train_photos.py` with SH of degree 3; colors are fitted where the training cameras see each
Gaussian, joined with the directions from which neighboring viewpoints between them see it. SH and SRBF renders are
both compared with every 8th photograph, which neither training nor the fit has seen; images are clipped to [0, 1].
FLIP stands in for LPIPS, whose weights are not at hand. "wire" is what arrives after rounding to records.

Given: a trained bonsai, the number of terms asked for.
Measured: PSNR and SSIM against held-out photographs, SH and SRBF; the paper's own bonsai went from 30.543 (3DGS) to
    30.886 dB (SRBF).
Defaults chosen on: nika and flowers.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
from _harness import add_arguments, need, realdata, write_result
from numpy.typing import NDArray
from paper.held import HELD, fit_held

from gsvis.color import FitConfig, fit_srbf, quantize, record_bytes, sh_bytes
from gsvis.io import load_scene
from gsvis.prepare.importance import importance_from_views
from gsvis.render import flip, psnr, rasterize, ssim
from gsvis.scene.cameras import Cameras
from gsvis.train.photos import load_photos

SIZE = (400, 266)
POINTS = {
    "rgb": (1.0, 2.0, 4.0),
    "hsl": (2.0, 4.0),
    **dict.fromkeys(HELD, (2.0,)),
}
"""Mean terms a Gaussian."""
PAPER = {"hsv": -1.1532, "yuv": -0.6983, "hsl-l": -0.6593, "hsl": -0.1508}
"""dB lost against 3DGS in table 3."""


def between(cameras: Cameras) -> Cameras:
    """Cameras half-way from each to its nearest neighbor, looking as the first does."""
    eyes = cameras.viewpoints
    away = np.linalg.norm(eyes[:, None] - eyes[None], axis=2)
    np.fill_diagonal(away, np.inf)
    middle = 0.5 * (eyes + eyes[away.argmin(axis=1)])
    poses = cameras.viewmats.copy()
    poses[:, :3, 3] = -np.einsum("cij,cj->ci", poses[:, :3, :3], middle)
    return Cameras(poses, cameras.Ks, cameras.width, cameras.height)


def main() -> None:
    parser = add_arguments(argparse.ArgumentParser(description=__doc__))
    parser.add_argument("--scene-file", type=Path, help="PLY that train_photos.py --scene wrote")
    parser.add_argument("--variants", nargs="+", choices=tuple(POINTS), default=list(POINTS))
    arguments = parser.parse_args()
    need(arguments.scene_file, "--scene-file, what train_photos.py --scene wrote")
    g = load_scene(arguments.scene_file)
    train, held_out = load_photos(realdata() / "photos/bonsai", size=SIZE).views.split(8)
    targets = np.stack([held_out.image(k) for k in range(len(held_out))])

    def judged(images: NDArray[np.float32]) -> dict[str, float]:
        shown = images.clip(0.0, 1.0)
        return {
            "psnr": float(np.mean(psnr(shown, targets))),
            "ssim": float(np.mean(ssim(shown, targets))),
            "flip": float(np.mean(flip(shown, targets))),
        }

    reference = rasterize(g, held_out.cameras).images
    sh = judged(reference)
    print("SH", sh, flush=True)
    views = importance_from_views(g, train.cameras)
    sets = views.sets | importance_from_views(g, between(train.cameras)).sets
    rows: list[dict[str, Any]] = []
    figures: list[dict[str, Any]] = []
    for name in arguments.variants:
        for mean_terms in POINTS[name]:
            row: dict[str, Any] = {"variant": name}
            if name in HELD:  # records hold no such colors
                held = fit_held(g, sets, name, mean_terms, 8, views.importance)
                shown = np.stack([held.colors(g.means, eye) for eye in held_out.cameras.viewpoints])
                images = rasterize(g, held_out.cameras, colors=shown).images
                row["mean_terms"] = float(held.counts.mean())
            else:
                config = FitConfig(variant=name, mean_terms=mean_terms, max_terms=8)
                colors = fit_srbf(g, sets, config, importance=views.importance).colors
                images = rasterize(g, held_out.cameras, colors=colors).images
                wire = rasterize(g, held_out.cameras, colors=quantize(colors, "wire").dequantize()).images
                row["mean_terms"] = float(colors.counts.mean())
                row["bytes_per_gaussian"] = record_bytes(colors) / len(g)
                row["wire_psnr"] = judged(wire)["psnr"]
            row |= judged(images)
            row["psnr_against_sh"] = float(np.mean(psnr(images.clip(0, 1), reference.clip(0, 1))))
            row["lost"] = sh["psnr"] - row["psnr"]
            rows.append(row)
            print({k: v if isinstance(v, str) else round(v, 4) for k, v in row.items()}, flush=True)
            figures.append(
                {
                    "name": f"bonsai, {name}, {row['mean_terms']:.2f} terms a Gaussian: PSNR lost against SH",
                    "target": 0.1 if name == "rgb" and row["mean_terms"] <= 4.0 else None,
                    "reached": row["lost"],
                    "unit": "dB" + (f"; paper {-PAPER[name]:.2f}" if name in PAPER else ""),
                    "better": "lower",
                }
            )
            details = {"gaussians": len(g), "sh": sh, "sh_bytes": sh_bytes(3, 16), "rows": rows}
            write_result(arguments.out, "What do SRBF colors cost on photographs?", figures, details)  # so far


if __name__ == "__main__":
    main()
