"""Adam that touches few rows: the same values as torch's, which steps all of them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from gsvis.files.scratch import Scratch
from gsvis.train.lazy_adam import LazyAdam

RATES = {"angles": 0.01, "sizes": 0.03}
FALL = 0.97
STEPS = 25


def test_rows_take_the_steps_that_they_missed() -> None:
    rng = np.random.default_rng(5)
    start = {"angles": rng.normal(size=(30, 2)), "sizes": rng.normal(size=(30, 1))}
    start = {name: each.astype(np.float32) for name, each in start.items()}
    whole = {name: torch.tensor(each, dtype=torch.float64, requires_grad=True) for name, each in start.items()}
    dense = torch.optim.Adam([{"params": [each], "lr": RATES[name]} for name, each in whole.items()], eps=1e-30)
    fall = torch.optim.lr_scheduler.ExponentialLR(dense, FALL)
    lazy = LazyAdam({name: each.copy() for name, each in start.items()}, RATES, FALL, STEPS)
    for step in range(STEPS):
        rows = np.flatnonzero(rng.random(29) < (0.9 if step < 3 else 0.2))  # the last row has never a gradient
        found = lazy.read(rows)
        for name, each in whole.items():
            assert np.allclose(found[name], each.detach().numpy()[rows], atol=1e-5)
            by_rows = rng.normal(size=(len(rows), each.shape[1])).astype(np.float32)
            each.grad = torch.zeros_like(each)
            each.grad[rows] = torch.from_numpy(by_rows).double()
            found[name] = by_rows
        lazy.step(rows, found)
        dense.step()
        fall.step()
    lazy.finish()
    for name, each in whole.items():
        assert np.allclose(lazy.values[name], each.detach().numpy(), atol=2e-5)
        assert np.array_equal(lazy.values[name][29], start[name][29])


def test_moments_in_files_are_the_same(tmp_path: Path) -> None:
    rng = np.random.default_rng(6)
    start = {"angles": rng.normal(size=(3000, 2)).astype(np.float32)}
    ends = []
    for folder in (None, tmp_path):
        rng = np.random.default_rng(7)
        scratch = Scratch(folder)
        lazy = LazyAdam({"angles": scratch.copy(start["angles"])}, RATES, FALL, STEPS, scratch)
        for _ in range(STEPS):
            rows = np.flatnonzero(rng.random(3000) < 0.3)
            lazy.catch_up(rows)
            lazy.step(rows, {"angles": rng.normal(size=(len(rows), 2)).astype(np.float32)})
            scratch.release()
        lazy.finish()
        ends.append(lazy.values["angles"])
    assert not np.array_equal(ends[0], start["angles"])
    assert ends[0].tobytes() == ends[1].tobytes()
