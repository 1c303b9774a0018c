"""A bare scene for pages on the same machine: the Gaussians of any static form of it, in few large files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gsvis.export import StaticOptions, write_static
from gsvis.export._kernels.sets import pack_sets
from gsvis.export.harmonics import ZERO, Harmonics
from gsvis.export.near import _blocks_of
from gsvis.scene.procedural import random_scene
from tests.export.test_static import Reader


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_a_scene_for_pages_nearby_has_the_same_gaussians_in_few_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, degree: int
) -> None:
    monkeypatch.setattr("gsvis.export.parts.PART", 64)
    monkeypatch.setattr("gsvis.package.order.MOST_GAUSSIANS", 200)
    g = random_scene(np.random.default_rng(3), 900, sh_degree=degree)
    found = []
    for near in (False, True):
        write_static(tmp_path / str(near), g, StaticOptions(most_sets=None, is_near=near))
        read = Reader(tmp_path / str(near))
        rows = [read.by_id("records"), read.by_id("means").view(np.uint8)]
        rows = np.hstack([*rows, read.harmonics()] if degree else rows)
        found.append((read.scene, rows[np.lexsort(rows.T)]))
    (far, far_rows), (near, near_rows) = found
    assert np.array_equal(far_rows, near_rows)
    assert near["colors"] == far["colors"]
    assert near["code"] is None
    assert set(near["files"]) == {"index", "grid", "row", "plain"}
    assert near["files"]["plain"]["count"] < far["files"]["part"]["count"]
    if degree:
        assert near["harmonics"] == {key: far["harmonics"][key] for key in ("degree", "low", "high", "sets")}


def test_harmonics_are_rounded_as_elsewhere() -> None:
    rng = np.random.default_rng(5)
    coefficients = rng.normal(scale=0.3, size=(400, 8, 3)).astype(np.float32)
    ranges = Harmonics.from_coefficients(coefficients, 2)
    coefficients[:9] *= np.array([0.0, -1e9, 1e30, 1e-30, -1e-3, 7.0, -7.0, 1.0, -1.0], np.float32)[:, None, None]
    halves = (np.arange(-130, 131)[:, None] + 0.5) * (ranges.high / (255 - ZERO))  # halfway between two bytes
    coefficients[9:270] = halves[:, :, None]
    ids = rng.permutation(400)[:350]
    out = np.full((350, 32), 7, np.uint8)
    factors = np.repeat(np.float32(255 - ZERO) / ranges.high, 3)
    pack_sets(coefficients.reshape(400, -1), ids, factors, out)
    assert np.array_equal(out[:, :24], ranges.encode(coefficients)[ids] ^ ZERO)
    assert (out[:, 24:] == 7).all()


def test_blocks_of_a_scene_for_pages_nearby_are_neighbors_with_all_gaussians(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gsvis.export.near._ALONE", 100)
    means = np.random.default_rng(0).normal(size=(1000, 3)).astype(np.float32)
    blocks = _blocks_of(means)
    assert sorted(np.concatenate(blocks).tolist()) == list(range(1000))
    assert [len(block) for block in blocks] == [250] * 4
    spread = sum(float(means[block].var(axis=0).sum()) for block in blocks) / 4
    assert spread < 0.75 * float(means.var(axis=0).sum())
    same = _blocks_of(np.ones((1000, 3), np.float32))
    assert sorted(np.concatenate(same).tolist()) == list(range(1000))
