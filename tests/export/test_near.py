"""A bare scene for pages on the same machine: the Gaussians of any static form of it, in few large files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gsvis.export import StaticOptions, write_static
from gsvis.export.near import _blocks_of
from gsvis.scene.procedural import random_scene
from tests.export.test_static import Reader


def test_a_scene_for_pages_nearby_has_the_same_gaussians_in_few_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gsvis.export.parts.PART", 64)
    monkeypatch.setattr("gsvis.package.order.MOST_GAUSSIANS", 200)
    monkeypatch.setattr("gsvis.export.harmonics.LARGE_BLOCK", 300)
    g = random_scene(np.random.default_rng(3), 900, sh_degree=3)
    found = []
    for near in (False, True):
        write_static(tmp_path / str(near), g, StaticOptions(most_sets=None, is_near=near))
        read = Reader(tmp_path / str(near))
        rows = np.hstack([read.by_id("records"), read.harmonics(), read.by_id("means").view(np.uint8)])
        found.append((read.scene, rows[np.lexsort(rows.T)], read.data["part"] + read.data["sets"]))
    (far, far_rows, far_files), (near, near_rows, near_files) = found
    assert np.array_equal(far_rows, near_rows)
    assert (near["harmonics"]["block"], len(near["harmonics"]["bytes"])) == (300, 3)
    assert "block" not in far["harmonics"]
    assert near["harmonics"]["low"] == far["harmonics"]["low"]
    assert len(near_files) < len(far_files)
    assert sum(near["harmonics"]["worth"]) == pytest.approx(sum(far["harmonics"]["worth"]), rel=1e-3)


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
