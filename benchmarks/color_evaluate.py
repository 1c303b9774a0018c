"""What do SRBF colors cost for a new eye point, against spherical harmonics of degree 3?

A million Gaussians; terms at random centers, exactly 4 or on average 1 each; all take the same means, and new eyes turn
by turn. Bytes that each must read and write, and a sum over as many, show what memory alone would allow.

Given: random terms and SH of a million Gaussians.
Measured: time for a new eye, over SH of degree 3 in the same run.
Defaults chosen on: no scene.
"""

from __future__ import annotations

import argparse
import itertools
from collections.abc import Callable
from typing import Any

import numba
import numpy as np
from _harness import add_arguments, measure, measure_in_turn, write_result

from gsvis.color import Evaluator, SrbfTensors, sh_colors, to_sh
from gsvis.color.evaluate_torch import evaluate_torch
from gsvis.color.srbf import SrbfColors
from gsvis.color.variants import variant
from gsvis.scene.gaussians import Gaussians


def scene(n: int, rng: np.random.Generator) -> Gaussians:
    return Gaussians(
        rng.normal(size=(n, 3)), np.tile([1.0, 0, 0, 0], (n, 1)), np.full((n, 3), 0.01), np.full(n, 0.5),
        rng.normal(scale=0.5, size=(n, 1, 3)), rng.normal(scale=0.1, size=(n, 15, 3)),
    )  # fmt: skip


def terms(name: str, counts: np.ndarray, rng: np.random.Generator) -> SrbfColors:
    kind, n, total = variant(name), len(counts), int(counts.sum())
    return SrbfColors(
        name, rng.uniform(0.2, 0.8, (n, 3)), np.ones(n),
        np.concatenate([[0], np.cumsum(counts)]), rng.integers(0, len(kind.functions), total),
        np.stack([np.arccos(rng.uniform(-1, 1, total)), rng.uniform(-np.pi, np.pi, total)], axis=1),
        np.exp(rng.uniform(0, 3, total)), rng.normal(scale=0.1, size=(total, kind.intensities)),
    )  # fmt: skip


def figure(name: str, reached: float, unit: str, target: float | None = None) -> dict[str, Any]:
    return {"name": name, "target": target, "reached": reached, "unit": unit, "better": "lower"}


def main() -> None:
    parser = add_arguments(argparse.ArgumentParser(description=__doc__))
    parser.add_argument("--gaussians", type=int, default=1_000_000)
    parser.add_argument("--repeats", type=int, default=15)
    options = parser.parse_args()
    n, rng = options.gaussians, np.random.default_rng(0)
    g = scene(n, rng)
    four, poisson = np.full(n, 4), rng.poisson(1.0, n)
    colors = {
        "rgb, 4 terms": terms("rgb", four, rng),
        "rgb, 1 term on average": terms("rgb", poisson, rng),
        "hsl, 4 terms": terms("hsl", four, rng),
        "hsl, 1 term on average": terms("hsl", poisson, rng),
        "rgb, 4 terms on average": terms("rgb", rng.poisson(4.0, n), rng),
    }
    evaluators = {name: Evaluator(value) for name, value in colors.items()}
    active = rng.random(colors["rgb, 4 terms"].num_terms) < 0.25
    eyes = itertools.cycle(rng.normal(scale=3.0, size=(7, 3)))
    work: dict[str, Callable[[], object]] = {"SH degree 3": lambda: sh_colors(g, next(eyes))}
    for name, evaluator in evaluators.items():
        work[name] = lambda e=evaluator: e.colors(g.means, next(eyes))  # type: ignore[misc]
    work["rgb, a quarter of 4 terms active"] = lambda: evaluators["rgb, 4 terms"].colors(
        g.means, next(eyes), active=active
    )
    timings = measure_in_turn(work, repeats=options.repeats, warmup=2)
    threads = numba.get_num_threads()
    numba.set_num_threads(1)
    alone = measure_in_turn({k: work[k] for k in ("SH degree 3", "rgb, 4 terms")}, repeats=5, warmup=1)
    numba.set_num_threads(threads)
    prepare = measure(lambda: Evaluator(colors["rgb, 4 terms"]), repeats=3)
    part = slice(0, min(n, 20_000))
    back = measure(lambda: to_sh(colors["rgb, 4 terms"][part]), repeats=3)
    tensors = SrbfTensors.from_colors(colors["rgb, 4 terms"])
    torch_means = tensors.base.new_tensor(g.means)
    in_torch = measure(lambda: evaluate_torch(tensors, torch_means, [0.1, 0.2, 3.0]), repeats=3)
    read = np.ones(64 * 2**20, np.float32)  # 256 MiB
    rate = read.nbytes / measure(lambda: read.sum(), repeats=5).median  # one core's
    # Means, colors out; then coefficients and ids, or base, order, offsets, and 28 bytes a term.
    traffic = {"SH degree 3": 24 + 192 + 4} | {
        name: 24 + 12 + 1 + 8 + 28 * value.num_terms / n for name, value in colors.items()
    }
    sh, srbf = timings["SH degree 3"].median, timings["rgb, 4 terms"].median
    figures: list[dict[str, Any]] = [
        figure(f"{name}: time for a new eye, over SH degree 3", timing.median / sh, "times", 2.0)
        for name, timing in timings.items()
        if name != "SH degree 3"
    ]
    figures += [figure(f"{name}: one eye", timing.median * 1e3, "ms") for name, timing in timings.items()]
    figures.append(
        figure("rgb, 4 terms: one thread, over SH degree 3 on one thread",
               alone["rgb, 4 terms"].median / alone["SH degree 3"].median, "times")
    )  # fmt: skip
    for name, timing in alone.items():
        bound = n * traffic[name] / rate
        figures.append(figure(f"{name}: one thread, over summing as many bytes", timing.median / bound, "times"))
    figures += [
        figure(
            "rgb, 4 terms: bytes moved, over SH degree 3", traffic["rgb, 4 terms"] / traffic["SH degree 3"], "times"
        ),
        figure("rgb, 4 terms: preparing an Evaluator, over one evaluation", prepare.median / srbf, "times"),
        figure("rgb, 4 terms: torch over the kernels", in_torch.median / srbf, "times"),
        figure("rgb, 4 terms: back to SH, a million", back.median * 1e6 / (part.stop - part.start), "s"),
    ]
    write_result(
        options.out,
        "What do SRBF colors cost for a new eye point, against spherical harmonics of degree 3?",
        figures,
        {"gaussians": n, "threads": threads, "timings": timings, "one_thread": alone, "bytes_per_gaussian": traffic,
         "read_rate_one_core": rate, "prepare": prepare, "torch": in_torch, "to_sh": back},
    )  # fmt: skip


if __name__ == "__main__":
    main()
