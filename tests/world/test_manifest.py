"""The manifest of a world: what is written is read, and what contradicts itself is refused."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gsvis.errors import FormatError
from gsvis.world.manifest import WorldManifest
from tests.world.manifests import example


def write(path: Path, change: Callable[[dict[str, Any]], object]) -> Path:
    """A changed manifest, under a hash of its own."""
    value = json.loads(example().to_json())
    del value["sha256"]
    change(value)
    text = json.dumps(value, sort_keys=True, separators=(",", ":"))
    path.write_text(json.dumps({**value, "sha256": hashlib.sha256(text.encode()).hexdigest()}))
    return path


def test_what_is_written_is_read(tmp_path: Path) -> None:
    example().write(tmp_path / "world.json")
    found = WorldManifest.read(tmp_path / "world.json")
    assert found == example()
    assert found.to_json() == example().to_json()
    assert len(found) == 6
    assert found.node(3) == found.districts[0]
    assert found.tiles[0].beyond is not None
    assert found.tiles[0].beyond.count == 11
    assert found.tiles[0].beyond.pieces[0].ids().tolist() == [0, 1, 2, 3, 6, 7]


def test_points_are_found_in_tiles() -> None:
    points = [[0.0, -1.0, 99.0], [1.999, 0.9, 0.0], [2.0, 0.0, 0.0], [6.0, 0.0, 0.0], [0.0, -1.001, 0.0], [1e300, 0, 0]]
    assert example().tiles_at(points).tolist() == [0, 0, 1, -1, -1, -1]
    assert example().tiles_at(np.zeros((0, 3))).tolist() == []


def test_unknown_nodes_are_refused() -> None:
    with pytest.raises(ValueError, match=r"node: expected a number in \[0, 6\), got 6"):
        example().node(6)


def test_a_changed_byte_is_found(tmp_path: Path) -> None:
    path = tmp_path / "world.json"
    path.write_bytes(example().to_json().replace(b'"bytes": 10', b'"bytes": 11', 1))
    with pytest.raises(FormatError, match="the hash of the rest"):
        WorldManifest.read(path)


BAD: dict[str, tuple[Callable[[dict[str, Any]], object], str]] = {
    "format": (lambda v: v.update(format="gsvis-package"), "is this a world"),
    "newer": (lambda v: v.update(version=3), "at most 2, got 3; update gsvis"),
    "older": (lambda v: v.update(version=1), "expected 2, got 1; prepare the world again"),
    "up": (lambda v: v.update(up=[0, 0, 2]), "a unit axis"),
    "twice": (lambda v: v["tiles"].__setitem__(1, v["tiles"][0] | {"beyond": None}), "each square once"),
    "order": (lambda v: (v["tiles"][0].update(beyond=None), v["tiles"].reverse()), "outside as the last|each square"),
    "square": (lambda v: v["tiles"][1].update(coords=[2, 0]), r"squares within \(3, 1\)"),
    "overlap": (lambda v: v["tiles"][0].update(shape=[2, 1]), "each square once"),
    "grid": (lambda v: v["grid"].update(shape=[4096, 2048]), "at most 4,194,304 squares"),
    "no tile": (lambda v: v.update(tiles=[], districts=[]), "1 to 1,048,576 tiles"),
    "digest": (lambda v: v["tiles"][0]["package"].update(sha256="../../x"), "64 hexadecimal digits"),
    "box": (lambda v: v["tiles"][0].update(low=[9, 9, 9]), "a corner above"),
    "level": (lambda v: v["tiles"][0].update(levels=[]), "1 to 16 levels"),
    "node": (lambda v: v["tiles"][0]["beyond"]["pieces"][0].update(node=6), "an integer from 0 to 5"),
    "itself": (lambda v: v["tiles"][0]["beyond"]["pieces"][0].update(node=0), "each tile in one node"),
    "district": (lambda v: v["tiles"][0]["beyond"]["pieces"][2].update(node=4), "each tile in one node"),
    "around": (lambda v: v["tiles"][0]["beyond"]["pieces"][2].update(node=5), "each tile in one node"),
    "runs": (lambda v: v["tiles"][0]["beyond"]["pieces"][0].update(runs=[[6, 2], [0, 4]]), "ascending runs"),
    "no level": (
        lambda v: v["tiles"][0]["beyond"]["pieces"][0].update(level=2),
        "one of 2 levels of node 1, got level 2",
    ),
    "no ids": (
        lambda v: v["tiles"][0]["beyond"]["pieces"][0].update(runs=[[0, 4], [6, 3]]),
        "ids of node 1, below 8, got an end at 9",
    ),
    "ids": (lambda v: v["tiles"][0]["beyond"]["pieces"][1].update(runs=[[3, 2]]), "each id once"),
    "member": (lambda v: v["districts"][2].update(tiles=[0, 3]), "numbers of tiles below 3"),
    "later": (lambda v: v["districts"].reverse(), "numbers of nodes before it below 3"),
    "parents": (lambda v: v["districts"].append(v["districts"][2]), "each node once"),
    "children": (lambda v: v["districts"][2].update(children=[3]), "those of its children"),
    "mixed": (lambda v: v["districts"][2].update(children=[0, 4]), "those of its children"),
    "side": (lambda v: v["grid"].update(side=0.0), "a number > 0"),
    "axes": (lambda v: v["grid"].update(axes=[1, 1]), "two axes, ascending"),
}


@pytest.mark.parametrize("fault", BAD)
def test_contradictions_are_refused(tmp_path: Path, fault: str) -> None:
    change, message = BAD[fault]
    with pytest.raises(FormatError, match=message):
        WorldManifest.read(write(tmp_path / "world.json", change))
