"""Solid voxels as octrees: what is written reads back; a small file by hand; damaged files end in one line."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gsvis.errors import FormatError
from gsvis.io.voxels import Voxels, load_voxels, save_voxels


def voxels_of(shape: tuple[int, int, int], share: float, seed: int = 0) -> Voxels:
    solid = np.random.default_rng(seed).random(shape) < share
    solid[: shape[0] // 2] = True  # so that whole blocks, and blocks of blocks, are solid
    return Voxels(np.array([-1.0, 2.0, 0.5]), 0.25, solid)


@pytest.mark.parametrize("shape", [(1, 1, 1), (4, 4, 4), (33, 18, 7), (16, 64, 5)])
@pytest.mark.parametrize("share", [0.0, 0.02, 0.5, 1.0])
def test_what_is_written_reads_back(shape: tuple[int, int, int], share: float, tmp_path: Path) -> None:
    given = voxels_of(shape, share)
    save_voxels(given, tmp_path / "a.voxel.json")
    found = load_voxels(tmp_path / "a.voxel.json")
    points = np.random.default_rng(1).uniform(-2, 20, (4000, 3))
    assert np.array_equal(found.is_solid(points), given.is_solid(points))
    centers = given.origin + (np.argwhere(np.ones(shape, bool)) + 0.5) * given.size
    assert np.array_equal(found.is_solid(centers), given.solid.ravel())
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.voxel.bin", "a.voxel.json"]


def test_a_single_voxel_by_hand(tmp_path: Path) -> None:
    solid = np.zeros((8, 8, 8), bool)
    solid[1, 2, 7] = True
    save_voxels(Voxels(np.zeros(3), 0.5, solid), tmp_path / "a.voxel.json")
    said = json.loads((tmp_path / "a.voxel.json").read_text())
    assert said["gridBounds"] == {"min": [-4.0, -4.0, 0.0], "max": [0.0, 0.0, 4.0]}
    assert (said["treeDepth"], said["nodeCount"], said["leafDataCount"], said["numInteriorNodes"]) == (1, 2, 2, 1)
    nodes = np.frombuffer((tmp_path / "a.voxel.bin").read_bytes(), "<u4")
    # Turned by 180 degrees about z the voxel is (6, 5, 7): child 1 + 2 + 4, and in its block (2, 1, 3).
    bit = 2 + 4 * 1 + 16 * 3
    assert nodes.tolist() == [1 << 24 + 7 | 1, 0, 0, 1 << (bit - 32)]


def test_what_is_solid_everywhere_is_one_node(tmp_path: Path) -> None:
    save_voxels(Voxels(np.zeros(3), 1.0, np.ones((16, 16, 16), bool)), tmp_path / "a.voxel.json")
    assert np.frombuffer((tmp_path / "a.voxel.bin").read_bytes(), "<u4").tolist() == [0xFF000000]


def test_outside_of_the_box_all_is_solid(tmp_path: Path) -> None:
    given = Voxels(np.zeros(3), 1.0, np.zeros((5, 5, 5), bool))
    save_voxels(given, tmp_path / "a.voxel.json")
    found = load_voxels(tmp_path / "a.voxel.json")
    points = np.array([[2.5, 2.5, 2.5], [5.5, 2.5, 2.5], [-0.5, 2.5, 2.5], [2.5, 2.5, 99.0]])
    for each in (given, found):
        assert each.is_solid(points).tolist() == [False, True, True, True]


def test_another_suffix_is_refused(tmp_path: Path) -> None:
    for call in (lambda path: save_voxels(voxels_of((4, 4, 4), 0.5), path), load_voxels):
        with pytest.raises(ValueError, match=r"ends with \.voxel\.json"):
            call(tmp_path / "a.json")


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("leafSize", 8),
        ("treeDepth", 0),
        ("treeDepth", 99),
        ("treeDepth", "1"),
        ("nodeCount", -1),
        ("nodeCount", 1 << 40),
        ("leafDataCount", 3),
        ("voxelResolution", 0.0),
        ("voxelResolution", "wide"),
        ("gridBounds", {"min": [0, 0, 0], "max": [1e9, 1, 1]}),
        ("gridBounds", {"min": [0, 0, 0], "max": [0.3, 1, 1]}),
        ("gridBounds", [1, 2]),
    ],
)
def test_a_damaged_header_is_said(key: str, value: Any, tmp_path: Path) -> None:
    save_voxels(voxels_of((9, 9, 9), 0.3), tmp_path / "a.voxel.json")
    said = json.loads((tmp_path / "a.voxel.json").read_text())
    (tmp_path / "a.voxel.json").write_text(json.dumps({**said, key: value}))
    with pytest.raises(FormatError, match=r"a\.voxel"):
        load_voxels(tmp_path / "a.voxel.json")


def test_damaged_nodes_read_or_are_said(tmp_path: Path) -> None:
    given = voxels_of((24, 24, 24), 0.3)
    save_voxels(given, tmp_path / "a.voxel.json")
    whole = (tmp_path / "a.voxel.bin").read_bytes()
    rng, refused = np.random.default_rng(2), 0
    for _ in range(200):
        data = bytearray(whole)
        for place in rng.integers(len(data), size=3).tolist():
            data[place] = int(rng.integers(256))
        (tmp_path / "a.voxel.bin").write_bytes(data[: len(data) - 4 * int(rng.integers(2))])
        try:
            load_voxels(tmp_path / "a.voxel.json")
        except FormatError:
            refused += 1
    assert 50 < refused < 200
