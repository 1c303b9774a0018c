"""INRIA PLY: every legal spelling reads to the same scene, and what was written reads back."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gsvis.errors import FormatError
from gsvis.io.ply import load_ply, sample_ply, save_ply
from gsvis.scene.gaussians import Gaussians
from tests.io.scene_files import ply_bytes, random_scene, raw_columns

FIELDS = ("means", "quats", "scales", "opacities", "sh0", "shN")


def assert_alike(got: Gaussians, want: Gaussians, rtol: float = 2e-6) -> None:
    assert len(got) == len(want)
    for name in FIELDS:
        np.testing.assert_allclose(getattr(got, name), getattr(want, name), rtol=rtol, atol=rtol, err_msg=name)


def load(tmp_path: Path, data: bytes) -> Gaussians:
    file = tmp_path / "scene.ply"
    file.write_bytes(data)
    return load_ply(file)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_every_degree_reads_with_channel_major_coefficients(tmp_path: Path, degree: int) -> None:
    scene = random_scene(sh_degree=degree)
    assert_alike(load(tmp_path, ply_bytes(raw_columns(scene))), scene)


@pytest.mark.parametrize("encoding", ["binary_little_endian", "binary_big_endian", "ascii"])
@pytest.mark.parametrize("kind", ["f4", "f8"])
def test_encodings_and_types(tmp_path: Path, encoding: str, kind: str) -> None:
    scene = random_scene()
    columns = raw_columns(scene)
    data = ply_bytes(columns, encoding=encoding, types=dict.fromkeys(columns, kind))
    assert_alike(load(tmp_path, data), scene)


def test_any_order_with_extra_columns_of_every_type(tmp_path: Path) -> None:
    scene = random_scene(sh_degree=2)
    columns = raw_columns(scene) | {f"extra_{kind}": np.zeros(len(scene)) for kind in ("u1", "i2", "i4", "f8")}
    names = list(columns)
    np.random.default_rng(1).shuffle(names)
    types = {f"extra_{kind}": kind for kind in ("u1", "i2", "i4", "f8")}
    assert_alike(load(tmp_path, ply_bytes({n: columns[n] for n in names}, types=types)), scene)


@pytest.mark.parametrize("encoding", ["binary_little_endian", "ascii"])
def test_other_elements_before_and_after(tmp_path: Path, encoding: str) -> None:
    scene = random_scene()
    rows = b"1 2\n3 4\n" if encoding == "ascii" else bytes(2 * 5)
    data = ply_bytes(
        raw_columns(scene),
        encoding=encoding,
        before="element camera 2\nproperty uchar a\nproperty float b",
        before_rows=rows,
        after="element face 1\nproperty list uchar int vertex_indices",
        after_rows=b"1 0\n" if encoding == "ascii" else bytes(5),
    )
    assert_alike(load(tmp_path, data), scene)


def test_windows_line_ends_in_the_header(tmp_path: Path) -> None:
    scene = random_scene()
    assert_alike(load(tmp_path, ply_bytes(raw_columns(scene), newline="\r\n")), scene)


def test_rows_beyond_one_chunk(tmp_path: Path) -> None:
    scene = random_scene(n=40_000, sh_degree=1)
    assert_alike(load(tmp_path, ply_bytes(raw_columns(scene))), scene)


@pytest.mark.parametrize("encoding", ["binary_little_endian", "binary_big_endian", "ascii"])
def test_a_sample_is_rows_of_the_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, encoding: str) -> None:
    monkeypatch.setattr("gsvis.io._ply_rows.CHUNK_BYTES", 4000)  # it comes in several pieces
    scene = random_scene(500)
    file = tmp_path / "scene.ply"
    file.write_bytes(ply_bytes(raw_columns(scene), encoding=encoding))
    found = sample_ply(file, 100)
    if encoding == "ascii":
        assert found is None
        return
    assert found is not None
    assert found[1] == 500
    assert_alike(found[0], scene[np.linspace(0, 499, 100).astype(np.int64)])
    assert sample_ply(file, 500) is None


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_what_was_written_reads_back(tmp_path: Path, degree: int) -> None:
    scene = random_scene(n=20_000 if degree == 3 else 100, sh_degree=degree)
    save_ply(scene, tmp_path / "deep" / "out.ply")
    again = load_ply(tmp_path / "deep" / "out.ply")
    assert_alike(again, scene, rtol=1e-6)
    np.testing.assert_array_equal(again.means, scene.means)
    np.testing.assert_array_equal(again.shN, scene.shN)


def test_extreme_opacities_and_scales_survive(tmp_path: Path) -> None:
    opacities = np.array([0.0, 1.0, 1e-30, np.nextafter(np.float32(1), np.float32(0)), 0.5], np.float32)
    scales = np.tile(np.array([[1e-37], [1e-20], [1.0], [1e20], [1e37]], np.float32), 3)
    scene = Gaussians(np.zeros((5, 3)), np.tile([1.0, 0, 0, 0], (5, 1)), scales, opacities, np.zeros((5, 1, 3)))
    save_ply(scene, tmp_path / "out.ply")
    again = load_ply(tmp_path / "out.ply")
    np.testing.assert_array_equal(again.opacities[[0, 1, 4]], opacities[[0, 1, 4]])
    np.testing.assert_allclose(again.opacities, opacities, rtol=1e-5)
    np.testing.assert_allclose(again.scales, scales, rtol=1e-5)


def test_infinite_logits_are_opacities_zero_and_one(tmp_path: Path) -> None:
    columns = raw_columns(random_scene(n=3))
    columns["opacity"] = np.array([-np.inf, np.inf, 0.0])
    assert load(tmp_path, ply_bytes(columns)).opacities.tolist() == [0.0, 1.0, 0.5]


def test_a_scale_that_underflows_stays_positive(tmp_path: Path) -> None:
    columns = raw_columns(random_scene(n=1))
    columns["scale_2"] = np.array([-200.0])
    assert 0.0 < load(tmp_path, ply_bytes(columns)).scales[0, 2] < 1e-37


@pytest.mark.parametrize("name", ["x", "f_dc_1", "f_rest_4", "scale_2", "rot_3"])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_values_that_are_not_finite_are_refused(tmp_path: Path, name: str, value: float) -> None:
    columns = raw_columns(random_scene())
    columns[name][17] = value
    if name == "scale_2" and value < 0.0:  # a flat Gaussian
        assert 0.0 < load(tmp_path, ply_bytes(columns)).scales[17, 2] < 1e-37
        return
    with pytest.raises(FormatError, match="finite"):
        load(tmp_path, ply_bytes(columns))


def test_an_opacity_that_is_no_number_is_refused(tmp_path: Path) -> None:
    columns = raw_columns(random_scene())
    columns["opacity"][3] = np.nan
    with pytest.raises(FormatError, match="opacities: expected finite"):
        load(tmp_path, ply_bytes(columns))


def test_a_zero_quaternion_is_no_rotation(tmp_path: Path) -> None:
    columns = raw_columns(random_scene())
    for i in range(4):
        columns[f"rot_{i}"][5] = 0.0
    assert load(tmp_path, ply_bytes(columns)).quats[5].tolist() == [1.0, 0.0, 0.0, 0.0]


def test_a_scale_beyond_float_is_refused(tmp_path: Path) -> None:
    columns = raw_columns(random_scene())
    columns["scale_0"][5] = 100.0
    with pytest.raises(FormatError, match="scales"):
        load(tmp_path, ply_bytes(columns))


@pytest.mark.parametrize("name", ["x", "opacity", "rot_3", "scale_1", "f_dc_0"])
def test_missing_properties_are_named(tmp_path: Path, name: str) -> None:
    columns = raw_columns(random_scene())
    del columns[name]
    with pytest.raises(FormatError, match=f"no {name}"):
        load(tmp_path, ply_bytes(columns))


@pytest.mark.parametrize("drop", ["f_rest_0", "f_rest_8"])
def test_a_gap_in_the_harmonics_is_refused(tmp_path: Path, drop: str) -> None:
    columns = raw_columns(random_scene())
    del columns[drop]
    with pytest.raises(FormatError, match="f_rest"):
        load(tmp_path, ply_bytes(columns))


def test_a_point_cloud_is_distinguished_from_a_scene(tmp_path: Path) -> None:
    cloud = {name: np.zeros(3) for name in ("x", "y", "z", "red", "green", "blue")}
    with pytest.raises(FormatError, match="point cloud"):
        load(tmp_path, ply_bytes(cloud))


def test_an_empty_scene_is_refused(tmp_path: Path) -> None:
    data = ply_bytes({name: column[:0] for name, column in raw_columns(random_scene()).items()})
    with pytest.raises(FormatError, match="empty scene"):
        load(tmp_path, data)


def test_every_truncation_is_refused(tmp_path: Path) -> None:
    data = ply_bytes(raw_columns(random_scene(n=4)))
    for size in [*range(0, len(data), 37), len(data) - 1]:
        with pytest.raises(FormatError):
            load(tmp_path, data[:size])


def test_ascii_truncated_or_garbled_is_refused(tmp_path: Path) -> None:
    data = ply_bytes(raw_columns(random_scene(n=4)), encoding="ascii")
    for bad in (data[:-200], data.replace(b"0.", b"0x", 1), data[: data.rindex(b" ")] + b"\n"):
        with pytest.raises(FormatError):
            load(tmp_path, bad)


@pytest.mark.parametrize("count", [10**9, 10**17, 10**18, 10**30])
@pytest.mark.parametrize("encoding", ["binary_little_endian", "ascii"])
def test_a_count_beyond_the_file_is_refused_before_memory_is_taken(tmp_path: Path, count: int, encoding: str) -> None:
    data = ply_bytes(raw_columns(random_scene(n=1)), encoding=encoding)
    with pytest.raises(FormatError):
        load(tmp_path, data.replace(b"element vertex 1\n", b"element vertex %d\n" % count))


@pytest.mark.parametrize(
    "header",
    [
        b"plyx\n",
        b"ply\nelement vertex 1\nend_header\n",
        b"ply\nformat binary_middle_endian 1.0\nend_header\n",
        b"ply\nformat ascii 1.0\nproperty float x\nend_header\n",
        b"ply\nformat ascii 1.0\nelement vertex -1\nend_header\n",
        b"ply\nformat ascii 1.0\nelement vertex 1\nproperty quad x\nend_header\n",
        b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float x\nend_header\n",
        b"ply\nformat ascii 1.0\nelement vertex 1\nelement vertex 1\nend_header\n",
        b"ply\nformat ascii 1.0\nelement face 1\nend_header\n1",
        b"ply\nformat ascii 1.0\nend_header\n",
        b"ply\n" + b"x" * 10_000,
        b"ply\nformat ascii 1.0\n" + b"comment\n" * 200_000,
    ],
)
def test_malformed_headers_are_refused(tmp_path: Path, header: bytes) -> None:
    with pytest.raises(FormatError):
        load(tmp_path, header)


def test_a_list_in_front_of_the_gaussians_is_refused(tmp_path: Path) -> None:
    before = "element face 1\nproperty list uchar int vertex_indices"
    with pytest.raises(FormatError, match="list"):
        load(tmp_path, ply_bytes(raw_columns(random_scene()), before=before, before_rows=bytes(5)))


@pytest.mark.realdata
def test_an_ordinary_ply_with_a_misleading_name(realdata: Path) -> None:
    scene = load_ply(realdata / "scenes" / "formats" / "gsplayer_scene.compressed.ply")
    assert len(scene) == 20_000
    assert scene.sh_degree == 0
