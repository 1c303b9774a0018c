"""Cameras that gsvis wrote come back bit by bit; what is damaged is refused by its place."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gsvis.errors import FormatError
from gsvis.io import load_cameras
from gsvis.io.report_cameras import describe_cameras
from gsvis.scene.cameras import Cameras


def written(folder: Path, cameras: list[dict[str, Any]] | None, kind: str = "gsvis-report") -> Path:
    path = folder / "report.json"
    path.write_text(json.dumps({"format": kind, "version": 1, **({} if cameras is None else {"cameras": cameras})}))
    return path


@given(st.integers(0, 2**32 - 1))
def test_cameras_come_back_bit_by_bit(tmp_path_factory: pytest.TempPathFactory, seed: int) -> None:
    rng = np.random.default_rng(seed)
    eyes = rng.normal(size=(3, 3)) * 10.0 ** rng.uniform(-3, 3)
    cameras = Cameras.look_at(eyes, eyes.mean(axis=0) + 0.1, width=37, height=21, fov=float(rng.uniform(20, 140)))
    folder = tmp_path_factory.mktemp("report")
    for kind in ("gsvis-report", "gsvis-rendering"):
        found = load_cameras(written(folder, describe_cameras(cameras), kind))
        assert np.array_equal(found.viewmats, cameras.viewmats)
        assert np.array_equal(found.Ks, cameras.Ks)
        assert (found.width, found.height, found.names) == (37, 21, cameras.names)


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("viewmat", [[1, 0], [0, 1]], r"cameras\[0\].viewmat"),
        ("viewmat", (2 * np.eye(4)).tolist(), "rigid"),
        ("viewmat", None, "viewmat"),
        ("K", [[-1, 0, 1], [0, 1, 1], [0, 0, 1]], "focal"),
        ("width", 0, "image size"),
        ("height", "tall", "height"),
        ("name", 3, "name"),
    ],
)
def test_damage_is_reported_with_its_place(key: str, value: object, message: str, tmp_path: Path) -> None:
    entry = describe_cameras(Cameras.orbit((0, 0, 0), 1.0, 1))[0]
    with pytest.raises(FormatError, match=message):
        load_cameras(written(tmp_path, [entry | {key: value}]))


def test_a_report_without_cameras_says_what_helps(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match="write the report again"):
        load_cameras(written(tmp_path, None))
    with pytest.raises(FormatError, match="an object"):
        load_cameras(written(tmp_path, [3]))  # type: ignore[list-item]
