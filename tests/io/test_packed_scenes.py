"""Compressed PLY, .splat and SPZ: decoded within their quantization, and refused when damaged."""

from __future__ import annotations

import gzip
import logging
import struct
from pathlib import Path

import numpy as np
import pytest
import zstandard

from gsvis.errors import FormatError
from gsvis.io._build import largest_from_three
from gsvis.io._kernels import spz as kernels
from gsvis.io.compressed_ply_writer import save_compressed_ply
from gsvis.io.losses import watch_losses
from gsvis.io.ply import load_ply
from gsvis.io.splat import load_splat
from gsvis.io.spz import load_spz, save_spz
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.morton import morton_order
from gsvis.scene.sh import rotation_of_sh
from tests.io.scene_files import compressed_ply_bytes, random_scene, splat_bytes, spz_bytes


def put(tmp_path: Path, name: str, data: bytes) -> Path:
    (tmp_path / name).write_bytes(data)
    return tmp_path / name


def assert_within(got: Gaussians, want: Gaussians, **steps: float) -> None:
    """Errors at most one step each; scales as logarithms, rotations as the sine of half the angle between them."""
    errors = {
        "means": np.abs(got.means - want.means).max(),
        "log_scales": np.abs(np.log(got.scales) - np.log(want.scales)).max(),
        "opacities": np.abs(got.opacities - want.opacities).max(),
        "sh0": np.abs(got.sh0 - want.sh0).max(),
        "shN": np.abs(got.shN - want.shN).max(initial=0.0),
        "turn": np.sqrt(max(0.0, 1 - np.abs(np.einsum("ij,ij->i", got.quats, want.quats)).min() ** 2)),
    }
    assert {name: value for name, value in errors.items() if value > steps[name]} == {}


# --- compressed PLY


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("count", [1, 256, 300])
def test_compressed_ply_within_its_quantization(tmp_path: Path, degree: int, count: int) -> None:
    scene = random_scene(count, degree)
    got = load_ply(put(tmp_path, "a.ply", compressed_ply_bytes(scene)))
    steps = {"means": 6 / 1023, "log_scales": 5 / 1023, "opacities": 0.5 / 254, "sh0": 3 / 254, "shN": 8 / 256}
    assert_within(got, scene, **steps, turn=0.003)


def test_compressed_ply_of_older_writers_without_color_ranges(tmp_path: Path) -> None:
    scene = random_scene(10, 0)
    got = load_ply(put(tmp_path, "a.ply", compressed_ply_bytes(scene, color_range=False)))
    np.testing.assert_allclose(got.sh0, scene.sh0, atol=1 / 254 / 0.282)


@pytest.mark.parametrize("count", [1, 256, 300])
def test_a_compressed_ply_is_written_as_the_plain_writer_does(tmp_path: Path, count: int) -> None:
    scene = random_scene(count, 2)
    save_compressed_ply(scene, tmp_path / "ours.compressed.ply")
    ours = load_ply(tmp_path / "ours.compressed.ply")
    plain = load_ply(put(tmp_path, "plain.ply", compressed_ply_bytes(scene[morton_order(scene.means)])))
    for name in ("means", "scales", "opacities", "sh0", "shN", "quats"):
        np.testing.assert_allclose(getattr(ours, name), getattr(plain, name), rtol=2e-6, atol=2e-6, err_msg=name)


def test_a_flyaway_in_a_compressed_ply_is_reported(tmp_path: Path) -> None:
    g = random_scene(300, 0)
    means = np.array(g.means)
    means[0] = 1e6
    with watch_losses() as losses:
        scene = Gaussians(means, g.quats, g.scales, g.opacities, g.sh0, g.shN)
        save_compressed_ply(scene, tmp_path / "a.compressed.ply")
    assert [(loss.what, loss.count) for loss in losses] == [("centers", 44)]


@pytest.mark.parametrize(
    ("old", "new"),
    [
        (b"element chunk 1", b"element chunk 2"),
        (b"element chunk 1", b"element other 1"),
        (b"property float min_scale_y", b"property float mini_scale_"),
        (b"property uint packed_color", b"property uint packed_colou"),
        (b"property uint packed_scale", b"property float packed_scale"),
        (b"element sh 70", b"element sh 69"),
        (b"property uchar f_rest_3\n", b""),
        (b"element vertex 70", b"element vertex 0"),
        (b"element vertex 70", b"element vertex 1000000000"),
        (b"binary_little_endian", b"ascii"),
    ],
)
def test_compressed_ply_that_contradicts_itself(tmp_path: Path, old: bytes, new: bytes) -> None:
    data = compressed_ply_bytes(random_scene(70, 1))
    assert old in data
    with pytest.raises(FormatError):
        load_ply(put(tmp_path, "a.ply", data.replace(old, new, 1)))


def test_compressed_ply_truncated(tmp_path: Path) -> None:
    data = compressed_ply_bytes(random_scene(5, 1))
    for size in range(0, len(data), 41):
        with pytest.raises(FormatError):
            load_ply(put(tmp_path, "a.ply", data[:size]))


# --- .splat


def test_splat_within_its_quantization(tmp_path: Path) -> None:
    scene = random_scene(200, 0)
    got = load_splat(put(tmp_path, "a.splat", splat_bytes(scene)))
    steps = {"means": 0.0, "log_scales": 1e-6, "opacities": 0.5 / 254, "sh0": 0.5 / 254 / 0.282, "shN": 0.0}
    assert_within(got, scene, **steps, turn=0.02)


@pytest.mark.parametrize("size", [0, 1, 31, 33, 95])
def test_splat_of_another_size(tmp_path: Path, size: int) -> None:
    with pytest.raises(FormatError, match="32 bytes"):
        load_splat(put(tmp_path, "a.splat", splat_bytes(random_scene(3, 0))[:-1].ljust(95)[:size]))


@pytest.mark.parametrize(("at", "value"), [(0, np.nan), (4, np.inf), (12, -1.0), (16, np.nan), (20, np.inf)])
def test_splat_with_invalid_numbers(tmp_path: Path, at: int, value: float) -> None:
    data = bytearray(splat_bytes(random_scene(3, 0)))
    data[32 + at : 36 + at] = struct.pack("<f", value)
    with pytest.raises(FormatError):
        load_splat(put(tmp_path, "a.splat", bytes(data)))


def test_splat_with_a_zero_quaternion_is_not_turned(tmp_path: Path) -> None:
    data = bytearray(splat_bytes(random_scene(3, 0)))
    data[32 + 28 : 64] = bytes([128] * 4)
    assert load_splat(put(tmp_path, "a.splat", bytes(data))).quats[1].tolist() == [1.0, 0.0, 0.0, 0.0]


# --- SPZ

SPZ_STEPS = {"log_scales": 0.5 / 16 + 1e-5, "opacities": 0.5 / 254, "sh0": 0.5 / 254 / 0.15, "shN": 0.5 / 127}
SPZ_MEANS = {1: 3e-3, 2: 1e-3, 3: 1e-3, 4: 1e-3}
SPZ_TURN = {1: 0.15, 2: 0.15, 3: 0.003, 4: 0.003}  # w of versions 1 and 2 is what three rounded bytes leave


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("version", [1, 2, 3, 4])
def test_spz_within_its_quantization(tmp_path: Path, version: int, degree: int) -> None:
    scene = random_scene(90, degree)
    got = load_spz(put(tmp_path, "a.spz", spz_bytes(scene, version)))
    assert_within(got, scene, **SPZ_STEPS, means=SPZ_MEANS[version], turn=SPZ_TURN[version])


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_spz_that_was_written_reads_back(tmp_path: Path, degree: int) -> None:
    scene = random_scene(300, degree)
    save_spz(scene, tmp_path / "deep" / "a.spz")
    got = load_spz(tmp_path / "deep" / "a.spz")
    assert_within(got, scene, **SPZ_STEPS, means=1e-5, turn=0.003)
    save_spz(got, tmp_path / "b.spz")
    again = load_spz(tmp_path / "b.spz")
    for name in ("means", "scales", "opacities", "sh0", "shN"):  # quantized once is quantized for good
        np.testing.assert_allclose(getattr(again, name), getattr(got, name), atol=1e-6, err_msg=name)


@pytest.mark.parametrize("degree", [0, 3])
def test_spz_compact_rounds_as_other_encoders(tmp_path: Path, degree: int) -> None:
    scene = random_scene(3000, degree)
    for name, compact in (("fine", False), ("small", True)):
        save_spz(scene, tmp_path / f"{name}.spz", compact=compact)
    fine, small = (load_spz(tmp_path / f"{name}.spz") for name in ("fine", "small"))
    steps = small.means * 2.0**12
    np.testing.assert_array_equal(steps, np.rint(steps))
    np.testing.assert_allclose(small.means, scene.means, atol=0.51 / 2**12)
    for name in ("quats", "scales", "opacities", "sh0"):
        np.testing.assert_array_equal(getattr(small, name), getattr(fine, name))
    turned = rotation_of_sh(np.diag([1.0, -1.0, -1.0]), degree).diagonal()[1:, None]
    wanted, got = (np.rint(g.shN * turned * 128.0 + 128.0) for g in (scene, small))
    for band, step in ((slice(0, 3), 8), (slice(3, None), 16)):
        rounded = (wanted[:, band] + step // 2) // step * step
        np.testing.assert_array_equal(got[:, band], np.clip(rounded, 0, 255))
    sizes = [(tmp_path / f"{name}.spz").stat().st_size for name in ("small", "fine")]
    assert sizes[0] < (0.75 if degree else 0.99) * sizes[1]


def test_kernels_unpack_as_plain_numpy() -> None:
    rng = np.random.default_rng(0)
    bits = rng.integers(0, 1 << 32, 5000, dtype=np.uint32)
    bits[:4] = [0, 0xFFFFFFFF, 0x3FFFFFFF, 0xC0000000]  # also three components longer than 1
    table = np.linspace(-0.9, 0.9, 1024, dtype=np.float32)
    three = table[np.stack([bits >> shift & 0x3FF for shift in (20, 10, 0)], axis=1)]
    wanted = largest_from_three(three.astype(np.float64), bits >> 30).astype(np.float64)
    wanted /= np.linalg.norm(wanted, axis=1, keepdims=True)
    columns, signs = np.array([1, 2, 3, 0]), np.array([1, -1, -1, 1], np.float32)
    got = np.empty((5000, 4), np.float32)
    kernels.unpack_quats(bits, table, columns, signs, got)
    np.testing.assert_allclose(got[:, columns], wanted * signs, atol=2e-7)

    low, high = rng.normal(size=(2, 20, 3)).astype(np.float32)
    units = [(bits >> shift & most) / np.float32(most) for shift, most in ((21, 2047), (11, 1023), (0, 2047))]
    unit, which = np.stack(units, axis=1).astype(np.float32), np.arange(5000) // 256
    spread = np.empty((5000, 3), np.float32)
    kernels.spread_111011(bits, low, high, 256, spread)
    np.testing.assert_array_equal(spread, low[which] * (1 - unit) + high[which] * unit)
    byte = bits.byteswap().view(np.uint8).reshape(-1, 4).astype(np.float32) / np.float32(255.0)
    alpha = np.empty(5000, np.float32)
    kernels.spread_8888(bits, low, high, 256, spread, alpha)
    np.testing.assert_array_equal(spread, low[which] * (1 - byte[:, :3]) + high[which] * byte[:, :3])
    np.testing.assert_array_equal(alpha, byte[:, 3])

    stream = rng.integers(0, 256, 9 * 500, dtype=np.uint8)
    padded = np.pad(stream.reshape(-1, 3), ((0, 0), (1, 0))).view("<i4")[:, 0] >> 8
    factors, points = np.array([0.5, -0.25, 2.0], np.float32), np.empty((500, 3), np.float32)
    kernels.unpack_fixed_points(stream, factors, points)
    np.testing.assert_array_equal(points, padded.reshape(-1, 3) * factors)
    rows, out = stream.reshape(500, 9), np.empty((500, 6), np.float32)
    kernels.unpack_higher(rows, np.tile(factors, 2), out)
    np.testing.assert_array_equal(out, (rows[:, :6].astype(np.float32) - 128) * np.tile(factors, 2))


def test_spz_spends_its_bits_on_the_extent(tmp_path: Path) -> None:
    far = random_scene(20, 0).transform(np.eye(3), (1e6, 0, 0))
    save_spz(far, tmp_path / "a.spz")
    again = load_spz(tmp_path / "a.spz")
    np.testing.assert_allclose(again.facts.to_source(again.means), far.means, atol=2e-5)
    apart = Gaussians.concatenate([far.transform(np.eye(3), scale=sign) for sign in (100.0, 1.0)])
    with pytest.raises(ValueError, match="2\\^23"):
        save_spz(apart, tmp_path / "b.spz")
    with pytest.raises(ValueError, match="at least one"):
        save_spz(Gaussians.empty(), tmp_path / "b.spz")
    assert not (tmp_path / "b.spz").exists()


def test_spz_opacity_ends_survive(tmp_path: Path) -> None:
    scene = random_scene(2, 0)
    scene = Gaussians(scene.means, scene.quats, scene.scales, [0.0, 1.0], scene.sh0)
    save_spz(scene, tmp_path / "a.spz")
    assert load_spz(tmp_path / "a.spz").opacities.tolist() == [0.0, 1.0]


@pytest.mark.parametrize("version", [3, 4])
def test_spz_extensions_are_skipped_unless_they_turn_the_scene(tmp_path: Path, version: int) -> None:
    scene = random_scene(30, 1)
    unknown = struct.pack("<II", 0xADBE0002, 12) + bytes(12)
    right_up_back, strange = (struct.pack("<III", 0xADBE0003, 4, system) for system in (4, 17))
    got = load_spz(put(tmp_path, "a.spz", spz_bytes(scene, version, extensions=unknown + right_up_back)))
    assert_within(got, scene, **SPZ_STEPS, means=1e-3, turn=0.003)
    assert got.facts.up == (0.0, -1.0, 0.0)
    with pytest.raises(FormatError, match="coordinate system 17"):
        load_spz(put(tmp_path, "a.spz", spz_bytes(scene, version, extensions=unknown + strange)))


def test_spz_of_degree_four_loses_it_with_a_warning(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    scene = random_scene(30, 3)
    data = bytearray(gzip.decompress(spz_bytes(scene, 3)))
    rows = np.frombuffer(bytes(data[-30 * 45 :]), np.uint8).reshape(30, 45)
    data[12] = 4
    data[-30 * 45 :] = np.pad(rows, ((0, 0), (0, 27))).tobytes()
    with caplog.at_level(logging.WARNING):
        got = load_spz(put(tmp_path, "a.spz", gzip.compress(bytes(data))))
    assert "degree 4" in caplog.text
    assert_within(got, scene, **SPZ_STEPS, means=1e-3, turn=0.003)


@pytest.mark.parametrize("version", [1, 2, 3, 4])
def test_spz_truncated(tmp_path: Path, version: int) -> None:
    data = spz_bytes(random_scene(20, 1), version)
    for size in [*range(0, len(data) - 8, 13), len(data) - 9]:  # gzip ends with 8 bytes that hold no data
        with pytest.raises(FormatError):
            load_spz(put(tmp_path, "a.spz", data[:size]))


@pytest.mark.parametrize(
    ("at", "value"), [(0, 0), (4, 0), (4, 5), (12, 5), (13, 31), (8, 0), (8, 255), (15, 7), (16, 0), (17, 255)]
)
def test_spz_with_a_wrong_header(tmp_path: Path, at: int, value: int) -> None:
    data = bytearray(spz_bytes(random_scene(20, 0), 4))
    data[at] = value
    with pytest.raises(FormatError):
        load_spz(put(tmp_path, "a.spz", bytes(data)))


def test_spz_bombs(tmp_path: Path) -> None:
    count = 100_000_000
    header = struct.pack("<4sIIBBBB", b"NGSP", 3, count, 3, 12, 0, 0)
    with pytest.raises(FormatError, match="promise"):
        load_spz(put(tmp_path, "a.spz", gzip.compress(header + bytes(1 << 20))))
    header = struct.pack("<4sIIBBBBI12x", b"NGSP", 4, count, 0, 12, 0, 5, 32)
    stream = zstandard.ZstdCompressor().compress(bytes(1 << 20))
    contents = b"".join(struct.pack("<QQ", len(stream), size * count) for size in (9, 1, 3, 3, 4))
    with pytest.raises(FormatError, match="promise"):
        load_spz(put(tmp_path, "b.spz", header + contents + 5 * stream))
    # a stream that holds more than the table of contents says
    header = struct.pack("<4sIIBBBBI12x", b"NGSP", 4, 1, 0, 12, 0, 5, 32)
    contents = b"".join(struct.pack("<QQ", len(stream), size) for size in (9, 1, 3, 3, 4))
    with pytest.raises(FormatError, match="got 10"):
        load_spz(put(tmp_path, "c.spz", header + contents + 5 * stream))


@pytest.mark.realdata
def test_biker_reads_alike_from_both_its_files(realdata: Path) -> None:
    formats = realdata / "scenes" / "formats"
    ply, spz = load_ply(formats / "biker.compressed.ply"), load_spz(formats / "biker.spz")
    assert len(ply) == len(spz) == 152_746
    held = Gaussians(ply.means, ply.quats, np.maximum(ply.scales, np.exp(-10.0)), ply.opacities, ply.sh0)
    assert_within(spz, held, **(SPZ_STEPS | {"shN": 0.0}), means=0.51 / 4096, turn=0.003)


@pytest.mark.realdata
def test_real_scenes_in_packed_formats(realdata: Path) -> None:
    formats = realdata / "scenes" / "formats"
    assert len(load_ply(formats / "guitar.compressed.ply")) == 90_854
    arkit = load_splat(formats / "arkit_scene.splat")
    assert len(arkit) == 116_906
    assert (arkit.opacities > 0.5).mean() == pytest.approx(0.01, abs=0.005)
