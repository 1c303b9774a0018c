"""Which ranking keeps most of a trained bonsai: equation 6, removal against the scene's own images, or summed weight?

Bare subsets of 18.7, 25, 34.9 and 50% of the Gaussians, nothing trained after; ranked by the 255 training photographs
at 400 x 266 or their cameras alone, judged by mean PSNR on every 8th photograph, which nothing has seen. "rounds" is
`prune`: removal measured again after each round, at half size.

Given: a trained bonsai, the share kept, training photographs or their cameras.
Measured: PSNR of bare subsets against held-out photographs.
Defaults chosen on: bonsai and showroom.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from _harness import add_arguments, need, realdata, write_result

from gsvis.io import load_scene
from gsvis.scene.cameras import Cameras
from gsvis.train import importance, load_photos, most_important, prune
from gsvis.train.likeness import mean_psnr

SHARES = (0.5, 0.349, 0.25, 0.187)
SAID = {
    "gradient": "equation 6, photographs",
    "removal": "removal, own images",
    "absolute": "removal, absolute change",
    "weight": "summed weight",
}


def main() -> None:
    parser = add_arguments(argparse.ArgumentParser(description=__doc__))
    parser.add_argument("--scene-file", type=Path, help="PLY that train_photos.py --scene wrote")
    arguments = parser.parse_args()
    need(arguments.scene_file, "--scene-file, what train_photos.py --scene wrote")
    g = load_scene(arguments.scene_file)
    train, held_out = load_photos(realdata() / "photos/bonsai", size=(400, 266)).views.split(8)
    counts = [round(share * len(g)) for share in SHARES]
    rows = {}
    for method, said in SAID.items():
        values = importance(g, train, method=method)
        rows[said] = [mean_psnr(g[most_important(g, values, count)], held_out) for count in counts]
        print(said, np.round(rows[said], 2).tolist(), flush=True)
    c = train.cameras
    small = Cameras(c.viewmats, c.Ks * np.array([0.5, 0.5, 1.0])[:, None], c.width // 2, c.height // 2)
    rows["rounds"] = [mean_psnr(g[mask], held_out) for mask in prune(g, small, counts, share=0.3)]
    print("rounds", np.round(rows["rounds"], 2).tolist(), flush=True)
    figures = [
        {
            "name": f"bonsai, {share:.1%} of the Gaussians by {said}",
            "target": None,
            "reached": level,
            "unit": "dB",
            "better": "higher",
        }
        for said, levels in rows.items()
        for share, level in zip(SHARES, levels, strict=True)
    ]
    details = {"gaussians": len(g), "whole_psnr": mean_psnr(g, held_out), "psnr": rows, "shares": SHARES}
    write_result(arguments.out, "Which ranking keeps most of a trained bonsai?", figures, details)


if __name__ == "__main__":
    main()
