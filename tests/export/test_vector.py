"""Static scenes as files and as what a reader finds in them, for other implementations (tests/export/vector.json).

After a change of the format that is meant: `python -m tests.export.test_vector --write`.
"""

from __future__ import annotations

import base64
import json
import sys
import tempfile
import zlib
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np

from gsvis.export import StaticOptions, write_static
from gsvis.package import Package
from gsvis.scene.procedural import random_scene
from tests.export.test_static import Reader
from tests.stream.worlds import package_of

VECTOR = Path(__file__).with_name("vector.json")


@patch("gsvis.export.parts.PART", 40)
@patch("gsvis.export.first._PIECE", (40, 40))
@patch("gsvis.export.glances._LEAST", 1)
@patch("gsvis.export.glances._MOST", 100)
def recorded(folder: Path) -> dict[str, Any]:
    with package_of(folder / "p.gsvis", 300, lattice=True) as package:
        write_static(folder / "package", package, StaticOptions(name="package"))
        found = {"package": spelled(folder / "package", package)}
    scene = random_scene(np.random.default_rng(7), 150, sh_degree=2)
    write_static(folder / "bare", scene, StaticOptions(name="bare"))
    with patch("gsvis.package.order.MOST_GAUSSIANS", 40):
        write_static(folder / "near", scene, StaticOptions(name="near", most_sets=None, is_near=True))
    return {**found, **{name: spelled(folder / name, None) for name in ("bare", "near")}}


def spelled(folder: Path, package: Package | None) -> dict[str, Any]:
    read = Reader(folder)
    said: dict[str, Any] = {
        "files": {path.name: base64.b64encode(path.read_bytes()).decode() for path in sorted(folder.iterdir())},
        "records": [record.tobytes().hex() for record in read.by_id("records")],
        "means": read.by_id("means").round(6).tolist(),
        "parts": [piece["ids"].tolist() for piece in read.pieces],
        "cells": [
            {"gains": gains.round(6).tolist(), "spheres": spheres.round(6).tolist()}
            for (gains, _), spheres in zip(read.cells(), read.spheres, strict=True)
        ],
    }
    if package is not None:
        said["terms"] = [[term.hex() for term in terms] for terms in read.terms()]
        said["centers"] = package.visibility.grid.centers.round(6).tolist()
    else:
        said["harmonics"] = [row.tobytes().hex() for row in read.harmonics()]
    return said


def content(file: tuple[str, str]) -> tuple[str, bytes]:
    """Kind and content of a file, unpacked: other builds of zlib pack the same content to other bytes."""
    kind, data = file[0].split("-")[0], base64.b64decode(file[1])
    if kind in ("index", "facts", "sets"):
        return kind, b"" if kind == "index" else zlib.decompress(data)  # sizes of packed files are in the index
    if kind == "plain":
        return kind, data
    if kind in ("part", "terms"):
        head = int.from_bytes(data[:4], "little")
        return kind, data[4:24] + zlib.decompress(data[24 : 24 + head]) + data[24 + head :]
    return kind, b""


def test_the_recorded_scenes_are_what_is_written(tmp_path: Path) -> None:
    kept = json.loads(VECTOR.read_text(encoding="utf-8"))
    made = json.loads(json.dumps(recorded(tmp_path)))
    for name in ("package", "bare", "near"):
        assert made[name]["parts"] == kept[name]["parts"]
        assert made[name]["records"] == kept[name]["records"]
        assert [content(each) for each in made[name]["files"].items()] == [
            content(each) for each in kept[name]["files"].items()
        ]


if __name__ == "__main__" and "--write" in sys.argv:
    with tempfile.TemporaryDirectory() as made_in:
        VECTOR.write_text(json.dumps(recorded(Path(made_in)), sort_keys=True) + "\n", encoding="utf-8")
