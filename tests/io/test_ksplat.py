"""`.ksplat`: what is read and written to the byte, what is kept, what is refused."""

from __future__ import annotations

import logging
import struct
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from gsvis.errors import FormatError
from gsvis.io import load_scene, save_scene
from gsvis.io.ksplat import load_ksplat, save_ksplat
from gsvis.scene.gaussians import Gaussians
from tests.io.scene_files import ksplat_bytes, random_scene

FIELDS = ("means", "quats", "scales", "opacities", "sh0", "shN")
LEVELS = (0, 1, 2)
SIZES = {0: (44, 80, 140), 1: (24, 42, 72), 2: (24, 33, 48)}  # bytes of a record by level and SH degree


def one() -> Gaussians:
    """Values that every level holds exactly, each field another."""
    higher = np.zeros((1, 8, 3))
    higher[0, :3] = [[0.25, 0.625, 0.75], [0.0, -0.25, -0.375], [1.0, 0.0, 0.0]]
    higher[0, 3:, 2] = [0.125, 0.0, 0.0, 0.0, -0.125]
    return Gaussians([[1.0, 2.0, 3.0]], [[0.5, 0.5, -0.5, 0.5]], [[0.25, 0.5, 2.0]], [1.0], np.zeros((1, 1, 3)), higher)


def save(scene: Gaussians, folder: Path, level: int) -> bytes:
    save_ksplat(scene, folder / "a.ksplat", compression=level)
    return (folder / "a.ksplat").read_bytes()


def test_the_layout_is_that_of_the_format_to_the_byte(tmp_path: Path) -> None:
    bands = [0.25, 0, 1, 0.625, -0.25, 0, 0.75, -0.375, 0]  # red, green, blue of band 1
    bands += [0.0] * 10 + [0.125, 0, 0, 0, -0.125]
    color = bytes([128, 128, 128, 255])
    for level in LEVELS:
        data = save(one(), tmp_path, level)
        assert data[:24] == struct.pack("<4B4IHH", 0, 1, 0, 0, 1, 1, 1, 1, level, 0)
        assert not any(data[44:4096])
        assert data[4096:4104] == struct.pack("<2I", 1, 1)
        assert data[4096 + 40 : 4096 + 42] == struct.pack("<H", 2)
        assert not any(data[4096 + 42 : 5120])
    data = save(one(), tmp_path, 0)
    assert not any(data[4104:4124])
    assert data[5120:] == struct.pack("<10f", 1, 2, 3, 0.25, 0.5, 2, 0.5, 0.5, -0.5, 0.5) + color + struct.pack(
        "<24f", *bands
    )
    data = save(one(), tmp_path, 1)
    size, buckets, block, stored, steps, _, full, partial = struct.unpack("<IIfHxxIIII", data[4104:4136])
    assert (size, buckets, block, stored, steps, full, partial) == (256, 1, 1.0, 12, 32767, 0, 1)
    assert data[5120:5124] == struct.pack("<I", 1)
    center = struct.unpack("<3f", data[5124:5136])
    places = [
        round((mean - middle) / (block / 2 / 32767)) + 32767 for mean, middle in zip((1, 2, 3), center, strict=True)
    ]
    record = struct.pack("<3H7e", *places, 0.25, 0.5, 2, 0.5, 0.5, -0.5, 0.5) + color
    assert data[5136:] == record + struct.pack("<24e", *bands)
    data = save(one(), tmp_path, 2)
    low, high = struct.unpack("<2f", data[36:44])
    assert data[5136:] == record + bytes(round((v - low) / (high - low) * 255) for v in bands)


@pytest.mark.parametrize("level", LEVELS)
@pytest.mark.parametrize("degree", [0, 1, 2])
def test_files_of_others_are_read_to_the_bit_of_what_they_hold(tmp_path: Path, level: int, degree: int) -> None:
    scene = random_scene(30, degree, seed=level)
    (tmp_path / "a.ksplat").write_bytes(ksplat_bytes([scene], level))
    got = load_scene(tmp_path / "a.ksplat")
    assert got.sh_degree == degree
    half = 16.0 / 2 / 32767 / 2
    np.testing.assert_allclose(got.means, scene.means, atol=half + 1e-6 if level else 0)
    np.testing.assert_allclose(got.scales, scene.scales, rtol=5e-4 if level else 0)
    np.testing.assert_allclose(got.quats, scene.quats, atol=5e-4 if level else 1e-7)
    np.testing.assert_allclose(got.opacities, scene.opacities, atol=0.5 / 255 + 1e-6)
    np.testing.assert_allclose(got.sh0, scene.sh0, atol=0.5 / 255 / 0.282 + 1e-6)
    np.testing.assert_allclose(got.shN, scene.shN, atol=(0.0, 5e-4, 0.5 * 1.9 / 255 + 1e-6)[level])


@pytest.mark.parametrize("level", LEVELS)
def test_sections_follow_each_other_and_lower_degrees_are_padded(tmp_path: Path, level: int) -> None:
    parts = [random_scene(9, 1, 1), random_scene(6, 2, 2), random_scene(5, 0, 3)]
    (tmp_path / "a.ksplat").write_bytes(ksplat_bytes(parts, level))
    got = load_ksplat(tmp_path / "a.ksplat")
    whole = Gaussians.concatenate(parts)
    assert got.sh_degree == 2
    np.testing.assert_allclose(got.means, whole.means, atol=2e-4)
    np.testing.assert_allclose(got.shN, whole.shN, atol=5e-3)
    assert not got.shN[:9, 3:].any()
    assert not got.shN[15:].any()


@pytest.mark.parametrize("level", LEVELS)
@pytest.mark.parametrize("degree", [0, 1, 2])
def test_what_is_written_reads_back_within_its_steps(tmp_path: Path, level: int, degree: int) -> None:
    scene = random_scene(3000, degree)
    data = save(scene, tmp_path, level)
    got = load_ksplat(tmp_path / "a.ksplat")
    order = pair(scene, got) if level else np.arange(3000)
    if level == 0:
        assert len(data) == 5120 + 3000 * SIZES[0][degree]
        for name in ("means", "scales", "quats", "shN"):
            np.testing.assert_array_equal(getattr(got, name), getattr(scene, name))
    else:
        buckets = struct.unpack("<I", data[4108:4112])[0]
        partial = struct.unpack("<I", data[4132:4136])[0]
        assert len(data) == 5120 + 3000 * SIZES[level][degree] + 12 * buckets + 4 * partial
        side = np.subtract(*scene.bounds()[::-1]).max() / 8
        np.testing.assert_allclose(got.means, scene.means[order], atol=side / 65534 * 0.51 + 1e-6)
        np.testing.assert_allclose(got.scales, scene.scales[order], rtol=5e-4)
        np.testing.assert_allclose(got.quats, scene.quats[order], atol=5e-4)
        reach = np.abs(scene.shN).max() if degree else 0.0
        np.testing.assert_allclose(got.shN, scene.shN[order], atol=reach / 254 + 1e-6 if level == 2 else 5e-4)
    np.testing.assert_allclose(got.opacities, scene.opacities[order], atol=0.5 / 255 + 1e-6)


def pair(scene: Gaussians, got: Gaussians) -> np.ndarray:
    """Which Gaussian of the scene each one of the file is, by its place."""
    found = cKDTree(scene.means).query(got.means)[1]
    assert len(np.unique(found)) == len(scene)
    return np.asarray(found)


def test_full_buckets_come_first_and_each_lies_in_its_block(tmp_path: Path) -> None:
    scene = random_scene(5000, 0)
    near = Gaussians(scene.means * [1, 1, 0.01], *(getattr(scene, name) for name in FIELDS[1:]))
    data = save(near, tmp_path, 1)
    buckets, block = struct.unpack("<If", data[4108:4116])
    full, partial = struct.unpack("<II", data[4128:4136])
    lengths = np.r_[np.full(full, 256), np.frombuffer(data, "<u4", partial, 5120)]
    centers = np.frombuffer(data, "<f4", 3 * buckets, 5120 + 4 * partial).reshape(-1, 3)
    assert (full + partial, lengths.sum()) == (buckets, 5000)
    assert 0 < lengths[full:].min() <= lengths[full:].max() < 256
    assert len(np.unique(centers[full:], axis=0)) == partial  # a block has one bucket that is not full
    assert partial <= 9 * 9 * 2
    away = load_ksplat(tmp_path / "a.ksplat").means - np.repeat(centers, lengths, axis=0)
    assert np.abs(away).max() <= block / 2 * 1.0001


def test_300_in_one_place_are_a_full_bucket_and_one_of_44(tmp_path: Path) -> None:
    g = random_scene(300, 0)
    data = save(Gaussians(np.ones((300, 3)), *(getattr(g, name) for name in FIELDS[1:])), tmp_path, 1)
    assert struct.unpack("<I", data[4108:4112]) + struct.unpack("<II", data[4128:4136]) == (2, 1, 1)
    assert struct.unpack("<I", data[5120:5124]) == (44,)


@pytest.mark.parametrize("level", [1, 2])
def test_floaters_far_away_cost_the_rest_nothing(tmp_path: Path, level: int) -> None:
    scene = random_scene(1000, 0)
    far = Gaussians([[2e4, 0, 0], [0, -3e6, 1e5], [1e30, -1e30, 0]], *(getattr(scene[:3], name) for name in FIELDS[1:]))
    save(Gaussians.concatenate([scene, far]), tmp_path, level)
    got = load_ksplat(tmp_path / "a.ksplat")
    near = got[np.abs(got.means).max(axis=1) < 10]
    assert len(near) == 1000
    np.testing.assert_allclose(near.means, scene.means[pair(scene, near)], atol=1e-4)
    rest = got.means[np.abs(got.means).max(axis=1) >= 10]
    np.testing.assert_allclose(rest[np.argsort(np.abs(rest).max(axis=1))], far.means, rtol=2e-4, atol=1.0)


@pytest.mark.parametrize("level", [1, 2])
@pytest.mark.parametrize("place", [0.0, 5.0, 1e-30])
def test_centers_that_coincide_and_extreme_scales(tmp_path: Path, level: int, place: float) -> None:
    g = random_scene(300, 0)
    scene = Gaussians(np.full((300, 3), place), g.quats, np.full((300, 3), [1e-30, 1e9, 1.0]), g.opacities, g.sh0)
    save(scene, tmp_path, level)
    got = load_ksplat(tmp_path / "a.ksplat")
    np.testing.assert_allclose(got.means, scene.means, atol=1e-4)
    np.testing.assert_array_equal(got.scales, np.full((300, 3), [2.0**-24, 65504.0, 1.0], np.float32))


def test_a_coefficient_of_zero_stays_zero_in_a_byte(tmp_path: Path) -> None:
    scene = random_scene(200, 2)
    higher = np.where(np.arange(24).reshape(8, 3) % 2 == 0, scene.shN, 0.0)
    save(Gaussians(scene.means, scene.quats, scene.scales, scene.opacities, scene.sh0, higher), tmp_path, 2)
    got = load_ksplat(tmp_path / "a.ksplat").shN
    np.testing.assert_allclose(got[:, np.arange(24).reshape(8, 3) % 2 == 1], 0.0, atol=1e-6)
    save(Gaussians(scene.means, scene.quats, scene.scales, scene.opacities, scene.sh0, 0 * higher), tmp_path, 2)
    np.testing.assert_allclose(load_ksplat(tmp_path / "a.ksplat").shN, 0.0, atol=1e-6)


def test_colors_beyond_0_to_1_are_clipped(tmp_path: Path) -> None:
    scene = one()
    bright = Gaussians(scene.means, scene.quats, scene.scales, [0.0], [[[10.0, -10.0, 0.0]]])
    save(bright, tmp_path, 0)
    got = load_ksplat(tmp_path / "a.ksplat")
    np.testing.assert_allclose(0.5 + 0.28209479 * got.sh0[0, 0], [1.0, 0.0, 128 / 255], atol=1e-6)
    assert got.opacities[0] == 0.0


def test_degree_3_is_reduced_with_one_line(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    scene = random_scene(40, 3)
    with caplog.at_level(logging.WARNING):
        save_scene(scene, tmp_path / "a.ksplat")
    assert [record.getMessage() for record in caplog.records] == [
        f"{tmp_path / 'a.ksplat'}: SH degree 3 is reduced to 2, the highest of .ksplat"
    ]
    assert load_scene(tmp_path / "a.ksplat").sh_degree == 2


@pytest.mark.parametrize("level", [3, -1, True, 1.5, "1"])
def test_another_compression_is_refused(tmp_path: Path, level: object) -> None:
    with pytest.raises(ValueError, match="compression: expected 0, 1 or 2"):
        save_ksplat(one(), tmp_path / "a.ksplat", compression=level)  # type: ignore[arg-type]
    assert list(tmp_path.iterdir()) == []


def changed(data: bytes, at: int, form: str, *values: float) -> bytes:
    new = struct.pack("<" + form, *values)
    return data[:at] + new + data[at + len(new) :]


FILE = ksplat_bytes([random_scene(10, 1)], 2)
SECTION = 4096
BAD = {
    "version": (changed(FILE, 0, "B", 1), "version 0.1"),
    "minor version": (changed(FILE, 1, "B", 0), "version 0.1"),
    "compression": (changed(FILE, 20, "H", 3), "compression 0, 1 or 2"),
    "sections beyond the file": (changed(FILE, 4, "I", 2**32 - 1), "4294967295 sections|4,294,967,295 sections"),
    "no section": (changed(FILE, 4, "I", 0), "0 Gaussians, as in the sections"),
    "count of the header": (changed(FILE, 16, "I", 11), "10 Gaussians, as in the sections, got 11"),
    "count of a section": (changed(FILE, SECTION, "I", 11), "section 0: expected at most 10 Gaussians, got 11"),
    "rows beyond the file": (changed(FILE, SECTION + 4, "I", 2**32 - 1), "section 0.*truncated"),
    "degree": (changed(FILE, SECTION + 40, "H", 3), "an SH degree of 0 to 2, got 3"),
    "block of nothing": (changed(FILE, SECTION + 16, "f", 0.0), "blocks above 0"),
    "block without end": (changed(FILE, SECTION + 16, "f", np.inf), "blocks above 0"),
    "block that is none": (changed(FILE, SECTION + 16, "f", np.nan), "blocks above 0"),
    "size of a bucket": (changed(FILE, SECTION + 20, "H", 8), "buckets of 12 bytes"),
    "full buckets": (changed(FILE, SECTION + 32, "I", 9), "buckets of 12 bytes"),
    "few in buckets": (changed(FILE, SECTION + 8, "I", 1), "buckets: expected room for 10 Gaussians, got 4"),
    "limits of SH": (changed(FILE, 36, "ff", 1.0, 1.0), "least SH coefficient below"),
    "limits without end": (changed(FILE, 40, "f", np.inf), "least SH coefficient below"),
    "center": (changed(FILE, SECTION + 1024 + 4, "f", np.nan), "means: expected finite"),
    "rotation": (changed(FILE, len(FILE) - 10 * 33 + 12, "4e", np.nan, 0, 0, 0), "quats"),
    "scale": (changed(FILE, len(FILE) - 10 * 33 + 6, "e", -1.0), "scales"),
    "end": (FILE[:-1], "section 0.*truncated"),
    "head": (FILE[:4000], "4,096 bytes, got 4,000"),
    "nothing but zeros": (bytes(6000), "version 0.1"),
}


@pytest.mark.parametrize("what", BAD)
def test_bad_files_are_refused_in_one_line_that_names_the_place(tmp_path: Path, what: str) -> None:
    data, message = BAD[what]
    (tmp_path / "a.ksplat").write_bytes(data)
    with pytest.raises(FormatError, match=message) as caught:
        load_scene(tmp_path / "a.ksplat")
    assert "\n" not in str(caught.value)


def test_a_file_of_many_promises_takes_no_memory(tmp_path: Path) -> None:
    sections = [changed(FILE[SECTION : SECTION + 1024], at, "I", 2**32 - 1) for at in (0, 8, 12, 32, 36)]
    for section in sections:
        data = changed(FILE[:4096], 4, "I", 50) + section * 50 + FILE[5120:]
        (tmp_path / "a.ksplat").write_bytes(data)
        tracemalloc.start()
        with pytest.raises(FormatError):
            load_scene(tmp_path / "a.ksplat")
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert peak < 4 << 20


@pytest.mark.parametrize(("level", "at", "form"), [(0, 12, "f"), (1, 6, "e"), (2, 6, "e")])
def test_a_scale_that_underflowed_is_the_smallest_one(tmp_path: Path, level: int, at: int, form: str) -> None:
    data = ksplat_bytes([random_scene(1, 0)], level)
    row = len(data) - (44 if level == 0 else 24)
    (tmp_path / "a.ksplat").write_bytes(changed(data, row + at, form, 0.0))
    assert load_scene(tmp_path / "a.ksplat").scales[0, 0] == np.finfo(np.float32).tiny


def test_header_zeros_stand_for_the_usual_limits_of_sh(tmp_path: Path) -> None:
    (tmp_path / "a.ksplat").write_bytes(changed(changed(FILE, 36, "ff", 0.0, 0.0), 24, "3f", 9.0, 9.0, 9.0))
    got = load_scene(tmp_path / "a.ksplat").shN
    (tmp_path / "b.ksplat").write_bytes(changed(FILE, 36, "ff", -1.5, 1.5))
    np.testing.assert_array_equal(got, load_scene(tmp_path / "b.ksplat").shN)
