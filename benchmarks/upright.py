"""Is a scene found upright, or does gsvis say that it is not sure?

Each scene is looked at as it is, and moved: turned at random, scaled between 1e-3 and 1e3, shifted, in a shell of
outliers out to 5,000 times its core. Only the Gaussians are looked at: no cameras, no statement of a file.

Given: 13 real scenes and four built-in ones; which way is up in each, by a person who looked at renders.
Measured: the angle between what is found and the truth, the confidence, and processor time. "Wrong" is said with a
confidence of at least 0.8 and more than 10 degrees off.
Defaults chosen on: the same scenes moved by seeds 0 to 4 and 42, and 34 made or cropped scenes; this run moves by
another seed.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
from _chosen_eyes import Chosen, load_chosen
from _harness import add_arguments, realdata, write_result
from chosen_eyes import shell
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from gsvis.scene.axes import tilt_of
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.upright import SURE, find_up

F64 = NDArray[np.float64]

RIGHT = 10.0  # degrees
TARGET = 24 / 26
_DOWN_Y = (0.0, -1.0, 0.0)
_UP_Z = (0.0, 0.0, 1.0)
# Name, place below the folder of real data, level of detail, and the truth; none where a person cannot tell.
TRUTH: tuple[tuple[str, str, int | None, tuple[float, float, float] | None], ...] = (
    ("showroom", "scenes/showroom/lod-meta.json", 3, _UP_Z),
    ("nika", "scenes/nika_sh3/lod-meta.json", 0, _DOWN_Y),
    ("flowers", "scenes/flowers_sh2/lod-meta.json", 1, _DOWN_Y),
    ("biker", "scenes/formats/biker.compressed.ply", None, _DOWN_Y),
    ("biker as SPZ", "scenes/formats/biker.spz", None, _DOWN_Y),
    ("guitar", "scenes/formats/guitar.compressed.ply", None, _DOWN_Y),
    ("arkit", "scenes/formats/arkit_scene.splat", None, None),
    ("gsplayer", "scenes/formats/gsplayer_scene.compressed.ply", None, (0.0, 1.0, 0.0)),
    ("garden", "scenes/formats/garden_points.npz", None, _UP_Z),
    ("massa", "scenes/statues/massa.sog", None, _DOWN_Y),
    ("trumpet", "scenes/statues/trumpet.sog", None, _DOWN_Y),
    ("relief", "scenes/uncropped/relief.sog", None, _DOWN_Y),
    ("owl", "scenes/uncropped/owl.sog", None, _DOWN_Y),
    ("wall_with_hole", "builtin:wall_with_hole", None, _UP_Z),
    ("box_in_room", "builtin:box_in_room", None, _UP_Z),
    ("two_rooms", "builtin:two_rooms", None, _UP_Z),
    ("nested_shells", "builtin:nested_shells", None, None),
)


def main() -> None:
    parser = add_arguments(argparse.ArgumentParser(description=__doc__))
    parser.add_argument("--seed", type=int, default=43)
    parser.add_argument("--moves", type=int, default=3, help="random moves of each scene")
    options = parser.parse_args()
    folder = realdata()
    rows = []
    for number, (name, path, lod, truth) in enumerate(TRUTH):
        g = _load(path, lod, folder)
        rows.append(look(g, truth) | {"scene": name, "moved": False})
        for k in range(options.moves):
            moved, turn = move(g, np.random.default_rng([options.seed, number, k]))
            rows.append(look(moved, None if truth is None else turn @ np.array(truth)) | {"scene": name, "moved": True})
        print(name, [(row["verdict"], row["degrees_off"], row["confidence"]) for row in rows[-1 - options.moves :]])
    write_result(options.out, "Is a scene found upright, or does gsvis say that it is not sure?", summarize(rows), {
        "seed": options.seed, "moves": options.moves, "sure_from": SURE, "right_within_degrees": RIGHT, "rows": rows,
    })  # fmt: skip


def summarize(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the figures."""
    verdicts = Counter(row["verdict"] for row in rows)
    judged = [row for row in rows if row["degrees_off"] is not None]
    near = sum(row["degrees_off"] <= RIGHT for row in judged)
    seconds = max(row["processor_s"] for row in rows)
    return [
        _figure("share right or not sure", TARGET, 1.0 - verdicts["wrong"] / len(rows), "share", "higher"),
        _figure("confidently wrong", 0, verdicts["wrong"], "scenes", "lower"),
        _figure("share right and sure", None, verdicts["right"] / len(rows), "share", "higher"),
        _figure("share within 10 degrees, sure or not", None, near / len(judged), "share", "higher"),
        _figure("longest processor time", 1.0, seconds, "s", "lower"),
    ]


def look(g: Gaussians, truth: Any) -> dict[str, Any]:
    """Return what is found in a scene, beside the truth."""
    start = time.process_time()
    found = find_up(g)
    seconds = time.process_time() - start
    off = None if truth is None else tilt_of(found.up, truth)
    near = off is not None and off <= RIGHT
    return {
        "gaussians": len(g),
        "truth": None if truth is None else [round(float(v), 4) for v in truth],
        "found": [round(float(v), 4) for v in found.up],
        "degrees_off": None if off is None else round(off, 2),
        "confidence": round(found.confidence, 3),
        "verdict": ("right" if near else "wrong") if found.sure else "not sure",
        "reason": found.reason,
        "processor_s": round(seconds, 2),
    }


def move(g: Gaussians, rng: np.random.Generator) -> tuple[Gaussians, F64]:
    """Return a scene turned, scaled and shifted in a shell of outliers, and the rotation."""
    turn = Rotation.random(random_state=int(rng.integers(1 << 31))).as_matrix()
    scale = float(10.0 ** rng.uniform(-3.0, 3.0))
    size = float(np.subtract(*g.bounds(0.5)[::-1]).max())
    shelled = Gaussians.concatenate([g, shell(g, rng)])
    return shelled.transform(turn, scale * size * rng.normal(size=3) * 10.0, scale), turn


def _load(path: str, lod: int | None, folder: Path) -> Gaussians:
    nowhere = np.zeros((0, 3))
    return load_chosen(Chosen(path, path, (), (), nowhere, nowhere, lod=lod), folder)


def _figure(name: str, target: float | None, reached: float, unit: str, better: str) -> dict[str, Any]:
    return {"name": name, "target": target, "reached": reached, "unit": unit, "better": better}


if __name__ == "__main__":
    main()
