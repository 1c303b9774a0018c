"""What other programs write: their names of columns, statements in comments, frames, doubles, bad rows, wrappings."""

from __future__ import annotations

import base64
import gzip
import json
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from gsvis.cli import main
from gsvis.color.sh import sh_colors
from gsvis.errors import FormatError
from gsvis.io.batches import align_batches, list_batches, read_batch
from gsvis.io.convert import convert_scene, merge_scenes
from gsvis.io.convert_batches import convert_batches
from gsvis.io.frames import fit_cameras, move_cameras
from gsvis.io.gltf_splats_writer import save_glb
from gsvis.io.invalid import dropping_invalid
from gsvis.io.losses import watch_losses
from gsvis.io.ply import load_ply, save_ply
from gsvis.io.scenes import check_scene, load_scene
from gsvis.io.spz import load_spz
from gsvis.scene.cameras import Cameras
from gsvis.scene.facts import SceneFacts
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.similarity import Similarity
from tests.io.scene_files import glb_parts, ply_bytes, random_scene, raw_columns, spz_bytes

UTM = np.array([500_123.25, 4_649_776.5, 212.0])


def put(folder: Path, name: str, data: bytes) -> Path:
    (folder / name).write_bytes(data)
    return folder / name


def with_comments(scene: Gaussians, *lines: str) -> bytes:
    data = ply_bytes(raw_columns(scene))
    return data.replace(b"comment made by a test\n", "".join(f"comment {line}\n" for line in lines).encode())


@pytest.mark.parametrize(
    ("lines", "up"),
    [
        (["Vertical Axis: z"], (0, 0, 1)),
        (["vertical axis: Y"], (0, 1, 0)),
        (["VERTICAL AXIS = x"], (1, 0, 0)),
        (["Vertical Axis: -z"], (0, 0, -1)),
        (["up axis: +y"], (0, 1, 0)),
        (["up_axis -y"], (0, -1, 0)),
        (["Up: negative y"], (0, -1, 0)),
        (["Z-up"], (0, 0, 1)),
        (["Vertical axis: 0 -2 0"], (0, -1, 0)),
        (["up vector: (0, 0.6, 0.8)"], (0, 0.6, 0.8)),
        (["Vertical Axis: y", "Vertical Axis: z"], (0, 0, 1)),
        (["Exported from Brush", "Vertical axis: y"], None),
        (["Exported from Brush", "Vertical axis: 0 0 1"], (0, 0, 1)),
        (["Vertical Axis: sideways"], None),
        (["backup axis: z"], None),
        (["Vertical Axis: nan 0 1"], None),
    ],
)
def test_comments_that_state_the_up_axis(tmp_path: Path, lines: list[str], up: tuple[float, ...] | None) -> None:
    facts = load_ply(put(tmp_path, "a.ply", with_comments(random_scene(), *lines))).facts
    assert facts.up == (None if up is None else pytest.approx(up))
    assert bool(facts.up_source) == (up is not None)


@pytest.mark.parametrize(
    ("lines", "wanted"),
    [
        (["SplatRenderMode: mip"], True),
        (["splatrendermode: MIP"], True),
        (["SplatRenderMode: default"], False),
        (["antialiased 1"], True),
        (["antialiased 0"], False),
        (["train_flags antialiasing"], True),
        (["antialiased 1", "SplatRenderMode: default"], False),
        ([], False),
    ],
)
def test_comments_that_state_antialiasing(tmp_path: Path, lines: list[str], wanted: bool) -> None:
    assert load_ply(put(tmp_path, "a.ply", with_comments(random_scene(), *lines))).facts.antialiased is wanted


def test_damaged_facts_of_gsvis_are_left_out(tmp_path: Path) -> None:
    for text in ("{", "[]", '{"up":[0,0,9]}', '{"origin":[1e999,0,0]}', '{"box":3,"meters_per_unit":-1}', "[" * 5000):
        data = with_comments(random_scene(), f"gsvis facts {text[:4000]}")
        assert load_ply(put(tmp_path, "a.ply", data)).facts == SceneFacts()


@pytest.mark.parametrize("prefix", ["scal_", "scalar_", "scalar_scal_", "sf_", "SF_", "scalar_sf_"])
def test_names_of_cloudcompare(tmp_path: Path, prefix: str) -> None:
    scene = random_scene(sh_degree=2)
    columns = {name if name in "xyz" else prefix + name: values for name, values in raw_columns(scene).items()}
    got = load_ply(put(tmp_path, "a.ply", ply_bytes(columns)))
    np.testing.assert_allclose(got.shN, scene.shN, rtol=1e-6)
    np.testing.assert_allclose(got.scales, scene.scales, rtol=1e-5)


def test_exact_names_win_over_variants(tmp_path: Path) -> None:
    scene = random_scene()
    columns = {"scal_opacity": np.full(len(scene), 9.0)} | raw_columns(scene)
    np.testing.assert_allclose(
        load_ply(put(tmp_path, "a.ply", ply_bytes(columns))).opacities, scene.opacities, rtol=1e-5
    )


def test_colors_in_place_of_harmonics(tmp_path: Path) -> None:
    scene = random_scene(sh_degree=0)
    columns = {name: values for name, values in raw_columns(scene).items() if not name.startswith("f_")}
    columns |= {name: np.full(len(scene), 255.0) for name in ("red", "green", "blue")}
    data = ply_bytes(columns, types=dict.fromkeys(("red", "green", "blue"), "u1"))
    np.testing.assert_allclose(load_ply(put(tmp_path, "a.ply", data)).sh0, 0.5 / 0.28209479, rtol=1e-6)


@pytest.mark.parametrize("degree", [4, 5])
def test_degrees_above_three_are_reduced_with_a_line(tmp_path: Path, degree: int) -> None:
    scene, wide = random_scene(20, 3), (degree + 1) ** 2 - 1
    columns = {name: values for name, values in raw_columns(scene).items() if not name.startswith("f_rest")}
    for channel in range(3):
        for k in range(wide):
            columns[f"f_rest_{channel * wide + k}"] = scene.shN[:, k, channel] if k < 15 else np.ones(20)
    with watch_losses() as losses:
        got = load_ply(put(tmp_path, "a.ply", ply_bytes(columns)))
    np.testing.assert_allclose(got.shN, scene.shN, rtol=1e-6)
    assert [loss.what for loss in losses] == ["SH"]


def test_two_scales_are_flat_gaussians(tmp_path: Path) -> None:
    scene = random_scene()
    columns = raw_columns(scene)
    del columns["scale_2"]
    got = load_ply(put(tmp_path, "a.ply", ply_bytes(columns)))
    np.testing.assert_allclose(got.scales[:, :2], scene.scales[:, :2], rtol=1e-5)
    assert got.scales[:, 2].max() < 1e-37


@pytest.mark.parametrize("name", ["filter_3D", "scal_filter_3D"])
def test_the_filter_of_mip_splatting_is_fused(tmp_path: Path, name: str) -> None:
    scene = random_scene()
    data = ply_bytes(raw_columns(scene) | {name: np.full(len(scene), 0.2)})
    got = load_ply(put(tmp_path, "a.ply", data))
    wide = np.sqrt(scene.scales.astype(float) ** 2 + 0.04)
    np.testing.assert_allclose(got.scales, wide, rtol=1e-5)
    shares = np.sqrt(np.prod(scene.scales.astype(float) ** 2, axis=1) / np.prod(wide**2, axis=1))
    np.testing.assert_allclose(got.opacities, scene.opacities * shares, rtol=1e-5)
    assert got.facts.antialiased


# --- coordinates far from (0, 0, 0)


def far_ply(scene: Gaussians, encoding: str = "binary_little_endian") -> tuple[bytes, NDArray[np.float64]]:
    places = scene.means.astype(float) + UTM
    columns = raw_columns(scene) | {name: places[:, k] for k, name in enumerate("xyz")}
    return ply_bytes(columns, encoding=encoding, types=dict.fromkeys("xyz", "f8")), places


@pytest.mark.parametrize("encoding", ["binary_little_endian", "binary_big_endian", "ascii"])
def test_double_coordinates_survive(tmp_path: Path, encoding: str) -> None:
    data, places = far_ply(random_scene(), encoding)
    got = load_ply(put(tmp_path, "a.ply", data))
    assert all(value % 10.0 == 0.0 for value in got.facts.origin)
    np.testing.assert_allclose(got.facts.to_source(got.means), places, atol=1e-6)
    save_ply(got, tmp_path / "b.ply")
    again = load_ply(tmp_path / "b.ply")
    assert again.facts.origin == got.facts.origin
    np.testing.assert_array_equal(again.means, got.means)


def test_text_that_declares_floats_keeps_its_digits(tmp_path: Path) -> None:
    scene = random_scene()
    places = scene.means.astype(float) + UTM
    columns = raw_columns(scene) | {name: places[:, k] for k, name in enumerate("xyz")}
    got = load_ply(put(tmp_path, "a.ply", ply_bytes(columns, encoding="ascii", types=dict.fromkeys("xyz", "f8"))))
    text = (tmp_path / "a.ply").read_bytes().replace(b"property double", b"property float")
    again = load_ply(put(tmp_path, "b.ply", text))
    np.testing.assert_array_equal(again.means, got.means)


def test_doubles_near_zero_need_no_origin(tmp_path: Path) -> None:
    scene = random_scene()
    data = ply_bytes(raw_columns(scene), types=dict.fromkeys("xyz", "f8"))
    assert load_ply(put(tmp_path, "a.ply", data)).facts == SceneFacts()


def test_a_translation_is_composed_in_double_precision(tmp_path: Path) -> None:
    scene = random_scene()
    got = load_ply(put(tmp_path, "a.ply", far_ply(scene)[0]))
    moved = convert_scene(got, translate=-UTM)
    assert moved.facts.origin == (0.0, 0.0, 0.0)
    np.testing.assert_allclose(moved.means, scene.means, atol=1e-6)
    back = convert_scene(moved, translate=UTM)
    np.testing.assert_allclose(back.facts.to_source(back.means), scene.means + UTM, atol=1e-6)
    turned = convert_scene(got, rotate=(0, 0, 90), scale=2.0)
    x, y, z = (scene.means.astype(float) + UTM).T
    np.testing.assert_allclose(turned.facts.to_source(turned.means), 2.0 * np.stack([-y, x, z], axis=1), atol=1e-5)


def test_a_crop_is_in_the_coordinates_of_the_file(tmp_path: Path) -> None:
    scene = random_scene()
    got = load_ply(put(tmp_path, "a.ply", far_ply(scene)[0]))
    middle = np.median(scene.means, axis=0)
    box = UTM + np.stack([middle - 2.0, middle + 2.0])
    inside = (np.abs(scene.means - middle) <= 2.0).all(axis=1)
    assert len(convert_scene(got, crop=box)) == inside.sum()


def test_batches_share_the_origin_of_the_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = random_scene(100)
    order = np.argsort(scene.means[:, 0])  # so that batches differ
    path = put(tmp_path, "a.ply", far_ply(scene[order])[0])
    whole = load_ply(path)
    monkeypatch.setattr("gsvis.io.batches.ROWS", 30)
    batches = list_batches(path)
    parts = [read_batch(batch) for batch in batches]
    assert len(parts) == 4
    assert {part.facts.origin for part in parts} == {whole.facts.origin}
    np.testing.assert_array_equal(Gaussians.concatenate(parts).means, whole.means)
    convert_batches([batches], tmp_path / "b.ply", lambda part: convert_scene(part, translate=(1, 2, 3)), drops=False)
    save_ply(convert_scene(whole, translate=(1, 2, 3)), tmp_path / "c.ply")
    assert (tmp_path / "b.ply").read_bytes() == (tmp_path / "c.ply").read_bytes()


def test_scenes_of_different_origins_meet_in_one_frame(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    one, other = random_scene(50), random_scene(40, seed=3)
    shifted = other.with_facts(SceneFacts(origin=(500_200.0, 4_649_700.0, 200.0)))
    path, near = put(tmp_path, "a.ply", far_ply(one)[0]), tmp_path / "b.ply"
    save_ply(shifted, near)
    merged = merge_scenes([load_ply(path), load_ply(near)])
    wanted = np.concatenate([one.means + UTM, shifted.facts.to_source(shifted.means)])
    np.testing.assert_allclose(merged.facts.to_source(merged.means), wanted, atol=1e-5)
    monkeypatch.setattr("gsvis.io.batches.ROWS", 30)
    scenes = [list_batches(path), list_batches(near)]
    assert len({read_batch(batch).facts.origin for scene in align_batches(scenes) for batch in scene}) == 1
    convert_batches(scenes, tmp_path / "c.ply", lambda part: part, drops=False)
    save_ply(merged, tmp_path / "d.ply")
    assert (tmp_path / "c.ply").read_bytes() == (tmp_path / "d.ply").read_bytes()


def test_floats_far_from_zero_are_kept_exactly(tmp_path: Path) -> None:
    scene = random_scene()
    places = (scene.means + np.float32(4.6e6)).astype(np.float32)
    columns = raw_columns(scene) | {name: places[:, k] for k, name in enumerate("xyz")}
    got = load_ply(put(tmp_path, "a.ply", ply_bytes(columns)))
    np.testing.assert_array_equal(got.facts.to_source(got.means), places.astype(float))
    save_glb(got, tmp_path / "a.glb")
    again = load_scene(tmp_path / "a.glb")
    np.testing.assert_array_equal(again.facts.to_source(again.means), places.astype(float))
    matrix = glb_parts((tmp_path / "a.glb").read_bytes())[0]["nodes"][0]["matrix"]
    assert matrix[12:15] == [4_600_000.0] * 3


# --- bad rows


def with_bad_rows(scene: Gaussians) -> bytes:
    columns = raw_columns(scene)
    columns["x"][7] = np.nan
    columns["scale_1"][11] = np.inf
    columns["opacity"][40] = np.nan
    return ply_bytes(columns)


def test_bad_rows_are_an_error_that_names_the_option(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match=r"3 of 70 rows.*--drop-invalid"):
        load_scene(put(tmp_path, "a.ply", with_bad_rows(random_scene())))


def test_bad_rows_are_dropped_on_request_and_counted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = random_scene()
    path = put(tmp_path, "a.ply", with_bad_rows(scene))
    with watch_losses() as losses:
        got = load_scene(path, drop_invalid=True)
    kept = np.delete(np.arange(70), [7, 11, 40])
    np.testing.assert_array_equal(got.means, scene.means[kept])
    assert [(loss.what, loss.count) for loss in losses] == [("rows", 3)]
    monkeypatch.setattr("gsvis.io.batches.ROWS", 30)
    with dropping_invalid(), watch_losses() as losses:
        batches = list_batches(path)
    assert [batch.count for batch in batches] == [28, 29, 10]
    assert [loss.count for loss in losses] == [3]
    np.testing.assert_array_equal(Gaussians.concatenate([read_batch(b) for b in batches]).means, got.means)


def test_a_file_of_bad_rows_alone_is_refused(tmp_path: Path) -> None:
    columns = raw_columns(random_scene())
    columns["y"][:] = np.nan
    path = put(tmp_path, "a.ply", ply_bytes(columns))
    with pytest.raises(FormatError, match="at least one valid row"):
        load_scene(path, drop_invalid=True)
    with dropping_invalid(), pytest.raises(FormatError, match="at least one valid row"):
        list_batches(path)


# --- frames and wrappings

FRAMES = (
    "LDB",
    "RDB",
    "LUB",
    "RUB",
    "LDF",
    "RDF",
    "LUF",
    "RUF",
    "LBD",
    "RBD",
    "LBU",
    "RBU",
    "LFD",
    "RFD",
    "LFU",
    "RFU",
)


@pytest.mark.parametrize("code", range(1, 17))
def test_frames_of_spz_stand_as_the_ply(tmp_path: Path, code: int) -> None:
    ahead = {"R": (1, 0, 0), "L": (-1, 0, 0), "D": (0, 1, 0), "U": (0, -1, 0), "F": (0, 0, 1), "B": (0, 0, -1)}
    axes = np.array([ahead[letter] for letter in FRAMES[code - 1]], float).T  # of the file, in the frame of a PLY
    scene = random_scene(20, 3)
    plain = load_spz(put(tmp_path, "a.spz", spz_bytes(scene, 3)))
    got = load_spz(put(tmp_path, "b.spz", spz_bytes(scene, 3, extensions=struct.pack("<III", 0xADBE0003, 4, code))))
    stored = plain.means * np.array([1, -1, -1])
    np.testing.assert_allclose(got.means, stored @ axes.T, atol=1e-6)
    turn = axes @ np.diag([1.0, -1.0, -1.0])
    np.testing.assert_allclose(got.covars(), turn @ plain.covars() @ turn.T, atol=1e-6)
    eye = np.array([1.3, -2.0, 0.7])
    np.testing.assert_allclose(sh_colors(got, turn @ eye), sh_colors(plain, eye), atol=1e-5)


def test_a_gzipped_ply_is_read(tmp_path: Path) -> None:
    scene = random_scene()
    path = put(tmp_path, "a.ply.gz", gzip.compress(ply_bytes(raw_columns(scene))))
    np.testing.assert_array_equal(load_scene(path).means, scene.means)
    assert [batch.kind for batch in list_batches(path)] == ["whole"]
    whole = path.read_bytes()
    for bad in (whole[:-30], whole[:100], gzip.compress(b"tar"), gzip.compress(b"ply\n")):
        with pytest.raises(FormatError):
            load_scene(put(tmp_path, "b.ply.gz", bad))


def test_a_gzip_that_would_fill_memory_is_refused(tmp_path: Path) -> None:
    head = ply_bytes(raw_columns(random_scene(1)))
    with pytest.raises(FormatError, match="promise"):
        load_scene(put(tmp_path, "a.ply.gz", gzip.compress(head + bytes(100 << 20))))


@pytest.mark.parametrize("name", ["a.ply", "a.spz", "a.splat", "a.sog", "meta.json", "lod-meta.json", "a.glb", "a.pt"])
def test_pointers_of_git_lfs_are_named(tmp_path: Path, name: str) -> None:
    text = b"version https://git-lfs.github.com/spec/v1\noid sha256:" + b"0" * 64 + b"\nsize 123456789\n"
    path = put(tmp_path, name, text)
    for where in (path, tmp_path) if name.endswith("json") else (path,):
        with pytest.raises(FormatError, match="git lfs pull"):
            check_scene(where)


@pytest.mark.parametrize("how", ["file", "data"])
def test_gltf_with_buffers_outside(tmp_path: Path, how: str) -> None:
    scene = random_scene(20, 1)
    turned = np.eye(4)
    turned[:3, 3] = 1.0, 2.0, 3.0
    save_glb(scene, tmp_path / "a.glb", upright=turned)
    document, binary = glb_parts((tmp_path / "a.glb").read_bytes())
    uri = (
        "my%20data.bin"
        if how == "file"
        else "data:application/octet-stream;base64," + base64.b64encode(binary).decode()
    )
    document["buffers"][0]["uri"] = uri
    put(tmp_path, "my data.bin", binary)
    got = load_scene(put(tmp_path, "a.gltf", json.dumps(document).encode()))
    np.testing.assert_allclose(got.means, scene.means + np.arange(1, 4), atol=1e-6)
    assert got.facts.up == (0.0, 1.0, 0.0)
    packed = load_scene(put(tmp_path, "a.gltf.gz", gzip.compress(json.dumps(document).encode())))
    np.testing.assert_array_equal(packed.means, got.means)
    for bad in ("../a.bin", "none.bin", "data:,x", "data:;base64,?", 3, "http://x/y.bin"):
        document["buffers"][0]["uri"] = bad
        with pytest.raises(FormatError):
            load_scene(put(tmp_path, "b.gltf", json.dumps(document).encode()))


def test_a_gzipped_glb_is_read(tmp_path: Path) -> None:
    scene = random_scene(20, 1)
    save_glb(scene, tmp_path / "a.glb", upright=np.eye(4))
    packed = put(tmp_path, "a.glb.gz", gzip.compress((tmp_path / "a.glb").read_bytes()))
    np.testing.assert_array_equal(load_scene(packed).means, load_scene(tmp_path / "a.glb").means)
    with pytest.raises(FormatError):
        load_scene(put(tmp_path, "b.glb.gz", gzip.compress((tmp_path / "a.glb").read_bytes()[:-40])))


def test_a_configuration_beside_a_checkpoint_states_antialiasing(tmp_path: Path) -> None:
    torch = pytest.importorskip("torch")
    g = random_scene(5, 0)
    raw = {"means": g.means, "scales": np.log(g.scales), "quats": g.quats, "opacities": g.opacities, "sh0": g.sh0}
    (tmp_path / "ckpts").mkdir()
    file = tmp_path / "ckpts" / "a.pt"
    torch.save({"splats": {name: torch.as_tensor(np.array(value)) for name, value in raw.items()}}, file)
    assert not load_scene(file).facts.antialiased
    put(tmp_path, "cfg.yml", b"!!python/object:x\nantialiased: true\n")
    assert load_scene(file).facts.antialiased


def test_facts_follow_the_scene() -> None:
    facts = SceneFacts(origin=(10.0, 0.0, 0.0), up=(0.0, 0.0, 1.0), antialiased=True, box=((0.0, 0, 0), (1.0, 2, 3)))
    scene = random_scene().with_facts(facts)
    assert scene[3:9].facts == facts
    assert scene.with_origin((0, 0, 0)).facts == replace(
        facts, origin=(0.0, 0.0, 0.0), box=((10.0, 0, 0), (11.0, 2, 3))
    )
    turned = scene.transform([[0, -1, 0], [1, 0, 0], [0, 0, 1]], (0, 0, 1), 2.0).facts
    assert turned.box == ((-4.0, 0.0, 1.0), (0.0, 2.0, 7.0))
    assert turned.origin == (0.0, 20.0, 0.0)
    joined = Gaussians.concatenate([scene, scene.with_facts(replace(facts, up=None, antialiased=False))])
    assert joined.facts == replace(facts, up=None, antialiased=False)


# --- commands


def test_commands_say_each_loss_once_and_drop_rows_on_request(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bright = Gaussians.concatenate([random_scene(), random_scene(seed=2)])
    bright = Gaussians(bright.means, bright.quats, bright.scales, bright.opacities, bright.sh0 + 9.0)
    columns = raw_columns(bright)
    columns["y"][4] = np.nan
    path, out = str(put(tmp_path, "a.ply", ply_bytes(columns))), str(tmp_path / "b.spz")
    assert main(["convert", path, out]) == 2
    assert "--drop-invalid" in capsys.readouterr().err
    assert main(["convert", path, out, "--drop-invalid"]) == 0
    lines = capsys.readouterr().err.splitlines()
    assert sum("1 of 140 rows are dropped" in line for line in lines) == 1
    assert sum("colors of 139 Gaussians are clipped" in line for line in lines) == 1
    assert all(line.startswith("gsvis: ") for line in lines)
    assert len(load_scene(out)) == 139


def test_a_built_in_scene_keeps_its_up_axis_and_box(tmp_path: Path) -> None:
    assert main(["convert", "builtin:two_rooms", str(tmp_path / "a.ply")]) == 0
    facts = load_scene(tmp_path / "a.ply").facts
    assert facts.up == (0.0, 0.0, 1.0)
    assert facts.box is not None


def test_cameras_of_a_file_stand_in_a_scene_with_an_origin(tmp_path: Path) -> None:
    here = Cameras.look_at([[1.0, 2.0, 3.0]], (0.0, 0.0, 0.0), width=8, height=6)
    there = here.with_origin(-UTM)
    np.testing.assert_allclose(there.viewpoints, here.viewpoints + UTM, atol=1e-6)
    scene = random_scene().with_facts(SceneFacts(origin=(float(UTM[0]), float(UTM[1]), float(UTM[2]))))
    for given in (here, there):  # of a report of gsvis, and of the source
        np.testing.assert_allclose(fit_cameras(scene, given).cameras.viewpoints, here.viewpoints, atol=1e-6)
    assert fit_cameras(random_scene(), there).cameras is there


def test_cameras_of_a_capture_are_moved_before_the_origin_is_taken_off(tmp_path: Path) -> None:
    here = Cameras.look_at([[1.0, 2.0, 3.0]], (0.0, 0.0, 0.0), width=8, height=6)
    scene = random_scene().with_facts(SceneFacts(origin=(float(UTM[0]), float(UTM[1]), float(UTM[2]))))
    transform = Similarity(scale=0.25, translation=(7.0, -3.0, 2.0))  # capture to the coordinates of the source
    capture = move_cameras(here.with_origin(-UTM), transform.inverse())
    rows = {"transform": np.eye(4)[:3].tolist(), "scale": 0.25}
    rows["transform"] = [[float(i == j) for j in range(3)] + [t / 0.25] for i, t in enumerate((7.0, -3.0, 2.0))]
    put(tmp_path, "dataparser_transforms.json", json.dumps(rows).encode())
    for frame in ("capture", "auto"):
        found = fit_cameras(scene, capture, tmp_path, frame=frame)  # type: ignore[arg-type]
        assert found.transform is not None
        np.testing.assert_allclose(found.cameras.viewpoints, here.viewpoints, atol=1e-6)
