"""Points of reconstructions: every encoding gives what was written; damaged files are refused, never guessed."""

from __future__ import annotations

import json
import struct
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gsvis.errors import FormatError
from gsvis.io.points import find_points, load_points
from gsvis.scene.cameras import Cameras
from gsvis.scene.points import PointCloud
from tests.io.colmap_files import write_model, write_points
from tests.io.scene_files import ply_bytes

CAMERAS = Cameras.orbit((0.0, 0.0, 0.0), 4.0, 3, width=64, height=48)


def cloud(n: int = 7) -> PointCloud:
    rng = np.random.default_rng(n)
    return PointCloud(rng.normal(size=(n, 3)), np.round(rng.random((n, 3)) * 255) / 255)


def assert_same(read: PointCloud, written: PointCloud) -> None:
    np.testing.assert_array_equal(read.means, written.means)
    np.testing.assert_allclose(read.colors, written.colors, atol=1e-6)


@pytest.mark.parametrize("text", [False, True])
def test_points_of_a_colmap_model_come_back_from_every_place_in_it(tmp_path: Path, text: bool) -> None:
    folder = write_model(tmp_path / "sparse" / "0", CAMERAS, cloud(), text=text)
    end = "txt" if text else "bin"
    for path in (tmp_path, tmp_path / "sparse", folder, folder / f"points3D.{end}", folder / f"images.{end}"):
        assert_same(load_points(path), cloud())
        assert find_points(path) == folder / f"points3D.{end}"


def test_a_model_without_points_has_none_and_an_empty_one_is_empty(tmp_path: Path) -> None:
    write_model(tmp_path, CAMERAS)
    assert find_points(tmp_path) is None
    with pytest.raises(FormatError, match=r"expected points: points3D .*, got none"):
        load_points(tmp_path)
    for end in ("bin", "txt"):
        write_points(tmp_path / f"points3D.{end}", cloud(0))
        assert len(load_points(tmp_path / f"points3D.{end}")) == 0
    with pytest.raises(FileNotFoundError):
        load_points(tmp_path / "nowhere")


@pytest.mark.parametrize("encoding", ["binary_little_endian", "binary_big_endian", "ascii"])
@pytest.mark.parametrize(("kind", "white"), [("u1", 255), ("u2", 65535), ("f4", 1), ("f8", 1)])
def test_a_ply_reads_alike_in_every_encoding_and_type(tmp_path: Path, encoding: str, kind: str, white: int) -> None:
    want = cloud()
    columns = dict(zip(("x", "y", "z", "nx"), [*want.means.T, np.zeros(len(want))], strict=True))
    for name, column in zip(("red", "green", "blue"), want.colors.T.astype(np.float64), strict=True):
        columns[name] = column if white == 1 else np.round(column * white)
    types = dict.fromkeys(("red", "green", "blue"), kind)
    (tmp_path / "cloud.ply").write_bytes(ply_bytes(columns, encoding=encoding, types=types))
    assert_same(load_points(tmp_path / "cloud.ply"), want)


def test_a_ply_without_colors_is_gray(tmp_path: Path) -> None:
    (tmp_path / "cloud.ply").write_bytes(ply_bytes(dict(zip("xyz", cloud().means.T, strict=True))))
    assert (load_points(tmp_path / "cloud.ply").colors == 0.5).all()


def test_a_transforms_json_names_its_points(tmp_path: Path) -> None:
    (tmp_path / "cloud.ply").write_bytes(ply_bytes(dict(zip("xyz", cloud().means.T, strict=True))))
    file = tmp_path / "transforms.json"
    file.write_text(json.dumps({"frames": [], "ply_file_path": "cloud.ply"}))
    assert len(load_points(tmp_path)) == len(load_points(file)) == len(cloud())
    for name, message in (("other.ply", "not there"), ("../cloud.ply", "leave the folder"), (3, "got int")):
        file.write_text(json.dumps({"frames": [], "ply_file_path": name}))
        with pytest.raises(FormatError, match=rf"ply_file_path: .*{message}"):
            load_points(file)
    file.write_text(json.dumps({"frames": []}))
    assert find_points(tmp_path) is None


def test_a_file_cut_anywhere_is_refused(tmp_path: Path) -> None:
    path = write_points(tmp_path / "points3D.bin", cloud(4))
    whole = path.read_bytes()
    for length in range(len(whole)):
        path.write_bytes(whole[:length])
        with pytest.raises(FormatError, match=r"points3D\.bin: byte \d"):
            load_points(path)


@given(at=st.integers(0, 10_000), junk=st.binary(min_size=1, max_size=9))
def test_damage_is_refused_or_harmless(tmp_path_factory: pytest.TempPathFactory, at: int, junk: bytes) -> None:
    path = write_points(tmp_path_factory.mktemp("damaged") / "points3D.bin", cloud())
    data = bytearray(path.read_bytes())
    at %= len(data)
    data[at : at + len(junk)] = junk
    path.write_bytes(data)
    try:
        assert len(load_points(path)) <= len(cloud())
    except FormatError as error:
        assert "\n" not in str(error)


@pytest.mark.parametrize("at", [0, 8 + 43])
def test_absurd_counts_are_refused_without_memory(tmp_path: Path, at: int) -> None:
    path = write_points(tmp_path / "points3D.bin", cloud())
    data = bytearray(path.read_bytes())
    data[at : at + 8] = struct.pack("<Q", 2**62)
    path.write_bytes(data)
    tracemalloc.start()
    with pytest.raises(FormatError, match=f"byte {at}: expected a possible number"):
        load_points(path)
    assert tracemalloc.get_traced_memory()[1] < 1 << 20
    tracemalloc.stop()


@pytest.mark.parametrize(
    "line", ["1 2 3", "1 a b c 1 2 3 0.1", "1 0 0 0 1 2 256 0.1", "1 0 0 0 1 -2 3 0.1", "1 0 0 0 1 2"]
)
def test_a_malformed_line_is_named(tmp_path: Path, line: str) -> None:
    (tmp_path / "points3D.txt").write_text(f"# points\n1 0 0 0 1 2 3 0.1\n{line}\n")
    with pytest.raises(FormatError, match="line 3: expected POINT3D_ID X Y Z R G B ERROR"):
        load_points(tmp_path / "points3D.txt")


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e300])
def test_positions_that_are_not_finite_are_named(tmp_path: Path, value: float) -> None:
    (tmp_path / "points3D.txt").write_text(f"1 0 0 0 1 2 3 0.1\n2 0 {value} 0 1 2 3 0.1\n")
    with pytest.raises(FormatError, match="point 1: expected a finite position"):
        load_points(tmp_path / "points3D.txt")
    columns = {"x": [0.0, 1.0], "y": [0.0, value], "z": [0.0, 0.0]}
    for encoding, where in (("binary_little_endian", r"byte \d+ \(row 1\)"), ("ascii", "row 1")):
        (tmp_path / "cloud.ply").write_bytes(ply_bytes(columns, encoding=encoding, types=dict.fromkeys("xyz", "f8")))
        with pytest.raises(FormatError, match=where + ": expected a finite position"):
            load_points(tmp_path / "cloud.ply")


def test_colors_that_are_none_are_refused(tmp_path: Path) -> None:
    base = {name: [0.0] for name in "xyz"}
    file = tmp_path / "cloud.ply"
    for columns, kind, message in (
        ({"red": [1.0], "green": [0.0], "blue": [2.0]}, "f4", r"row 0\): expected colors from 0 to white"),
        ({"red": [1.0], "green": [np.nan], "blue": [0.0]}, "f4", "got 1 nan 0"),
        ({"red": [1.0], "green": [0.0]}, "f4", "expected red, green and blue of one type"),
        ({"red": [1], "green": [0], "blue": [0]}, "i4", "got red int32"),
    ):
        file.write_bytes(ply_bytes(base | columns, types=dict.fromkeys(columns, kind)))
        with pytest.raises(FormatError, match=message):
            load_points(file)
    file.write_bytes(ply_bytes({"x": [0.0], "y": [0.0]}))
    with pytest.raises(FormatError, match="expected properties x, y, z, got no z"):
        load_points(file)


@pytest.mark.realdata
def test_the_points_of_bonsai(realdata: Path) -> None:
    points = load_points(realdata / "photos" / "bonsai")
    assert len(points) == 51_939
    assert np.abs(np.median(points.means, axis=0)).max() < 10
