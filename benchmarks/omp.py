"""Is orthogonal matching pursuit at least 50 times as fast as scikit-learn's, at equal or lower error?

162 directions (vertices of the twice subdivided icosahedron), 324 atoms (each vertex with two decays), 6 terms, every
core; both on smooth random signals, in turn. Beside it the machine's float32 matrix product (numpy's BLAS) and what of
its rate the correlation step reaches; and the load of a fit: 320 directions, each signal with its own mask, 4 terms.

Given: random smooth signals, the dictionary, the number of terms.
Measured: signals a second and error beside scikit-learn's in the same run.
Defaults chosen on: no scene.
"""

from __future__ import annotations

import argparse
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
from _harness import Timing, add_arguments, measure_in_turn, write_result
from numba import get_num_threads
from sklearn.linear_model import orthogonal_mp_gram

from gsvis.color import orthogonal_matching_pursuit, srbf_dictionary
from gsvis.color._kernels.products import BLOCK, WIDTH, multiply
from gsvis.scene.icosphere import icosphere

DECAYS = {324: (4.0, 16.0), 648: (2.0, 5.0, 12.0, 30.0)}


def signals_along(directions: np.ndarray, number: int, rng: np.random.Generator) -> np.ndarray:
    """Sums of twelve random lobes each, and a little noise."""
    signals = 0.02 * rng.normal(size=(number, len(directions))).astype(np.float32)
    for _ in range(12):
        centers = rng.normal(size=(number, 3))
        centers /= np.linalg.norm(centers, axis=1, keepdims=True)
        decays = np.exp(rng.uniform(0.0, 4.0, (number, 1)))
        heights = rng.normal(size=(number, 1))
        signals += (heights * np.exp(decays * (centers @ directions.T - 1.0))).astype(np.float32)
    return signals


def caps(directions: np.ndarray, number: int, rng: np.random.Generator) -> np.ndarray:
    """Masks as direction sets are: all that lies on one side of a random plane."""
    centers = rng.normal(size=(number, 3))
    centers /= np.linalg.norm(centers, axis=1, keepdims=True)
    return centers @ directions.T > rng.uniform(-1.0, 0.7, (number, 1))


def product_rates(signals: np.ndarray, atoms: int, repeats: int) -> tuple[dict[str, float], dict[str, Timing]]:
    """Float operations per second of BLAS on large squares, and on the correlation step; and of ours on that."""
    rng = np.random.default_rng(0)
    threads, depth = get_num_threads(), signals.shape[1]
    square = rng.normal(size=(2048, 2048)).astype(np.float32)
    rows = np.ascontiguousarray(signals[: len(signals) // (BLOCK * threads) * BLOCK * threads])
    panels = rng.normal(size=(-(-atoms // WIDTH), depth, WIDTH)).astype(np.float32)
    dictionary = rng.normal(size=(depth, atoms)).astype(np.float32)
    out = np.empty((len(rows), len(panels) * WIDTH), np.float32)
    plain = np.empty((len(rows), atoms), np.float32)
    parts = [slice(k * len(rows) // threads, (k + 1) * len(rows) // threads) for k in range(threads)]
    with ThreadPoolExecutor(threads) as pool:
        taken = measure_in_turn(
            {
                "squares": lambda: square @ square,
                "correlations, BLAS": lambda: np.matmul(rows, dictionary, out=plain),
                "correlations": lambda: list(pool.map(lambda part: multiply(rows[part], panels, out[part]), parts)),
            },
            repeats,
        )
    work = {"squares": 2.0 * 2048.0**3}
    return {name: work.get(name, 2.0 * len(rows) * depth * atoms) / t.median for name, t in taken.items()}, taken


def against_sklearn(number: int, theirs: int, repeats: int) -> dict[str, Any]:
    vertices, _ = icosphere(2)
    dictionary = srbf_dictionary(vertices, vertices, DECAYS[324]).values
    dictionary /= np.linalg.norm(dictionary, axis=0)
    signals = signals_along(vertices, number, np.random.default_rng(1))
    few = signals[:theirs].astype(np.float64)
    gram = dictionary.T @ dictionary
    found: dict[str, Any] = {}

    def ours() -> None:
        found["ours"] = orthogonal_matching_pursuit(dictionary, signals, max_terms=6)

    def sklearn() -> None:
        found["sklearn"] = orthogonal_mp_gram(gram, dictionary.T @ few.T, n_nonzero_coefs=6)

    taken = measure_in_turn({"ours": ours, "sklearn": sklearn}, repeats)
    codes, dense = found["ours"], found["sklearn"]
    picked = np.zeros((theirs, 324))
    np.put_along_axis(picked, codes.atoms[:theirs].astype(np.int64), codes.coefficients[:theirs], axis=1)
    errors = {name: ((few - x @ dictionary.T) ** 2).sum(axis=1) for name, x in (("ours", picked), ("theirs", dense.T))}
    rates, products = product_rates(signals, 324, repeats)
    return {
        "signals": number,
        "signals_for_sklearn": theirs,
        "signals_per_s": number / taken["ours"].median,
        "sklearn_signals_per_s": theirs / taken["sklearn"].median,
        "mean_squared_error_left": {name: float(e.mean()) for name, e in errors.items()},
        "mean_energy": float((few**2).sum(axis=1).mean()),
        "equal_supports": float(np.mean(((picked != 0.0) == (dense.T != 0.0)).all(axis=1))),
        "float_operations_per_s": rates,
        "timings": {**taken, **products},
    }


def masked(number: int, repeats: int) -> dict[str, Any]:
    """The load of a fit, with 324 and with 648 atoms, and with two channels that share their atoms."""
    vertices, faces = icosphere(2)
    directions = vertices[faces].mean(axis=1)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    rng = np.random.default_rng(2)
    signals, mask = signals_along(directions, number, rng), caps(directions, number, rng)
    both = np.stack([signals, signals[::-1]], axis=2)
    results = {}
    for atoms, channels in ((324, 1), (648, 1), (324, 2)):
        dictionary = srbf_dictionary(directions, vertices, DECAYS[atoms]).values
        values = signals if channels == 1 else both
        name = f"{atoms} atoms, {channels} channel(s)"
        taken = measure_in_turn(
            {name: lambda d=dictionary, v=values: orthogonal_matching_pursuit(d, v, max_terms=4, weights=mask)}, repeats
        )[name]
        # One product for the correlations of each channel, one for the lengths under the mask, one after each term
        # but the last.
        operations = 2.0 * number * 320 * atoms * (channels + 4)
        results[name] = {"signals_per_s": number / taken.median, "float_operations_per_s_in_products":
                         operations / taken.median, "timing": taken}  # fmt: skip
    return {"signals": number, "mean_share_seen": float(mask.mean()), **results}


def main() -> None:
    parser = add_arguments(argparse.ArgumentParser(description=__doc__))
    parser.add_argument("--signals", type=int, default=200_000)
    parser.add_argument("--for-sklearn", type=int, default=4_000)
    parser.add_argument("--masked", type=int, default=100_000)
    parser.add_argument("--repeats", type=int, default=5)
    options = parser.parse_args()
    plain = against_sklearn(options.signals, options.for_sklearn, options.repeats)
    fit = masked(options.masked, options.repeats)
    rates, left = plain["float_operations_per_s"], plain["mean_squared_error_left"]
    million = 2e6 / fit["324 atoms, 1 channel(s)"]["signals_per_s"]
    figures = [
        {"name": "signals per second over scikit-learn's", "target": 50.0,
         "reached": plain["signals_per_s"] / plain["sklearn_signals_per_s"], "unit": "ratio", "better": "higher"},
        {"name": "signals per second, 162 directions, 324 atoms, 6 terms", "target": None,
         "reached": plain["signals_per_s"], "unit": "1/s", "better": "higher"},
        {"name": "scikit-learn's", "target": None, "reached": plain["sklearn_signals_per_s"], "unit": "1/s",
         "better": "higher"},
        {"name": "mean squared error over scikit-learn's", "target": 1.0 + 1e-6,
         "reached": left["ours"] / left["theirs"], "unit": "ratio", "better": "lower"},
        {"name": "rate of the correlation step over BLAS on squares of 2048", "target": 0.5,
         "reached": rates["correlations"] / rates["squares"], "unit": "ratio", "better": "higher"},
        {"name": "rate of the correlation step over BLAS on the same", "target": None,
         "reached": rates["correlations"] / rates["correlations, BLAS"], "unit": "ratio", "better": "higher"},
        {"name": "masked signals per second, 320 directions, 324 atoms, 4 terms", "target": None,
         "reached": fit["324 atoms, 1 channel(s)"]["signals_per_s"], "unit": "1/s", "better": "higher"},
        {"name": "masked signals per second, 320 directions, 648 atoms, 4 terms", "target": None,
         "reached": fit["648 atoms, 1 channel(s)"]["signals_per_s"], "unit": "1/s", "better": "higher"},
        {"name": "pursuit of a fit: a million Gaussians, masked, two functions of 4 terms", "target": 300.0,
         "reached": million, "unit": "s", "better": "lower"},
    ]  # fmt: skip
    write_result(
        options.out,
        "Is orthogonal matching pursuit at least 50 times as fast as scikit-learn's, at equal or lower error?",
        figures,
        {"plain": plain, "masked": fit},
    )


if __name__ == "__main__":
    main()
