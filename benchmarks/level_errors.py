"""Why has a leaf more error in a view than the mean over eyes says: coarse pictures, or the mean?

Given: showroom with three levels and its visible sets, as in `level_choice.py` (--work of that benchmark); the eyes
    around which an export measures.
Measured: the error of each leaf at each eye whose cell has at least a thousandth of its light from the leaf. The same
    eyes with pictures of 512 and of 192 pixels, six eyes; the largest error over all eyes against the mean, weighted by
    light, with 192 pixels. Quantiles over leaves at the middle level.
Defaults chosen on: nothing.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
from _harness import add_arguments, need, write_result
from level_choice import open_scene

from gsvis.export.leaves import Leaves, cut_leaves
from gsvis.export.level_errors import SIDE, measure_errors, pick_eyes
from gsvis.export.needs import find_needs
from gsvis.pvs import VisibilityStore

FINE = 512
FEW = 6  # eyes with fine pictures
SEEN = 1e-3  # least share of the light of a cell
QUANTILES = (0.5, 0.75, 0.9)


def errors_of(leaves: Leaves, eyes: np.ndarray, side: int) -> np.ndarray:
    """Return (E, B) the error of each leaf at the middle level, by each eye alone."""
    return np.array([measure_errors(leaves, eye, side=side)[1] for eye in eyes])


def figures_of(coarse: np.ndarray, fine: np.ndarray, lights: np.ndarray) -> list[dict[str, Any]]:
    """Return the quantiles of both ratios: (E, B) errors by both kinds of pictures, and the light of leaves."""
    seen = lights >= SEEN * lights.sum(axis=1, keepdims=True)
    some = seen[: len(fine)] & (coarse[: len(fine)] > 0.0)
    finer = fine[some] / coarse[: len(fine)][some]
    weights = np.where(seen, lights, 0.0)
    many = seen.any(axis=0)
    mean = (weights * coarse).sum(axis=0)[many] / weights.sum(axis=0)[many]
    largest = np.where(seen, coarse, 0.0).max(axis=0)[many]
    apart = (largest / np.maximum(mean, 1e-12))[mean > 0.0]
    names = (f"pictures of {FINE} pixels against {SIDE}, at the same eye", "largest eye against the mean over eyes")
    return [
        {
            "name": f"showroom: {name}, quantile {quantile:g}",
            "target": None,
            "reached": float(np.quantile(values, quantile)),
            "unit": "times",
            "better": "lower",
        }
        for name, values in zip(names, (finer, apart), strict=True)
        for quantile in QUANTILES
    ]


def main() -> None:
    parser = add_arguments(argparse.ArgumentParser(description=__doc__))
    parser.add_argument("--work", type=Path, help="folder with the visible sets that level_choice.py built")
    args = parser.parse_args()
    need(args.work, "--work DIR: the folder of level_choice.py")
    levels, _ = open_scene("showroom")
    leaves = cut_leaves(levels)
    with VisibilityStore.open(args.work / "showroom-levels.pvs", scene=levels) as store:
        lights = find_needs(leaves, store).lights
        picked = pick_eyes(lights)
        eyes = store.grid.centers[picked]
    coarse = errors_of(leaves, eyes, SIDE)
    fine = errors_of(leaves, eyes[:FEW], FINE)
    question = "Why has a leaf more error in a view than the mean over eyes says: coarse pictures, or the mean?"
    write_result(args.out, question, figures_of(coarse, fine, lights[picked]), {"eyes": len(eyes)})


if __name__ == "__main__":
    main()
