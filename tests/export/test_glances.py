"""Glances of static sites: what they hold, against plain loops over eyes, and when there are none."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest

from gsvis.export import write_static
from gsvis.export.glances import glance_bytes
from gsvis.export.lights import Lights
from tests.export.test_static import Reader, matched
from tests.stream.worlds import package_of


def test_a_glance_has_what_pictures_in_the_cell_show_most_in_its_part_of_the_horizon(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gsvis.export.glances._LEAST", 1)
    monkeypatch.setattr("gsvis.export.glances._MOST", 240)
    with package_of(tmp_path / "s.gsvis", 700) as package:
        write_static(tmp_path / "out", package)
        read, g = Reader(tmp_path / "out"), package.contents.gaussians()
        of, lights = matched(read, package), Lights(package, g)
        highest = package.contents.last == len(package.contents.names) - 1
        drawn = [lights.drawn_in(cell, highest) for cell in range(len(lights))]
    read.cells()
    east, north, up = np.array(read.scene["cells"]["glances"]["axes"])
    assert np.allclose(up, read.scene["up"])
    some = 0
    for number, data in enumerate(read.data["glance"]):
        cell, sector = divmod(number, 8)
        (ids, _), _, eyes, by_eye = drawn[cell]
        shown = np.zeros(len(g))
        for eye, light in zip(eyes, by_eye, strict=True):
            x, y, z = ((g.means[ids] - eye) @ np.array([east, north, up]).T).T
            turn = np.mod(np.degrees(np.arctan2(y, x)) + 180.0, 360.0)
            inside = (turn >= 45 * sector) & (turn < 45 * sector + 45)
            shown[ids] += light * inside * (np.abs(np.degrees(np.arctan2(z, np.hypot(x, y)))) <= 50.0)
        if not data:
            assert not shown.any()
            continue
        at = 4 + struct.unpack_from("<I", data)[0]
        head, _, _, _, records, coded = struct.unpack_from("<6I", data, at)
        held = of[read.piece(data[at : at + 24 + head + records + coded])["ids"]]
        assert 0 < len(held) <= 21  # 12 bytes each
        rest = np.setdiff1d(np.flatnonzero(shown), held)
        assert shown[held].min() >= shown[rest].max(initial=0.0)
        some += len(rest) > 0
    assert some


def test_files_of_glances_are_left_out_where_each_would_be_too_small() -> None:
    assert glance_bytes(100, 10_000_000) == 1500
    assert 0 < 8 * 100 * 1.35 * glance_bytes(100, 1_000_000) <= 1_000_000
    assert glance_bytes(100, 400_000) == glance_bytes(0, 0) == 0
