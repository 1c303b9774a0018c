"""glTF with Gaussians: read back alike, known answers of a plain writer, nodes applied, damage refused in a line."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gsvis.errors import FormatError
from gsvis.io import load_scene
from gsvis.io.gltf_splats_writer import MOST_BYTES, check_size, encode_glb, save_glb
from gsvis.scene.gaussians import Gaussians, quats_from_rotations
from gsvis.scene.sh import SH_C0
from tests.io.scene_files import glb_bytes, glb_parts, random_scene

NAMES = ("means", "scales", "opacities", "sh0", "shN")


def read(tmp_path: Path, data: bytes) -> Gaussians:
    (tmp_path / "a.glb").write_bytes(data)
    return load_scene(tmp_path / "a.glb")


def changed(data: bytes, change: Any) -> bytes:
    """The same file after a change of its JSON."""
    document, binary = glb_parts(data)
    change(document)
    return glb_bytes(document, binary)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_a_plain_file_holds_every_value(tmp_path: Path, degree: int) -> None:
    g = random_scene(20, degree, degree)
    again = read(tmp_path, encode_glb(g))
    for name in (*NAMES, "quats"):
        np.testing.assert_array_equal(getattr(again, name), getattr(g, name))


def test_the_attributes_are_those_of_the_specification() -> None:
    g = random_scene(5, 1, 0)
    document, binary = glb_parts(encode_glb(g))
    (primitive,) = document["meshes"][0]["primitives"]
    assert (primitive["mode"], document["extensionsUsed"]) == (0, ["KHR_gaussian_splatting"])
    assert primitive["extensions"]["KHR_gaussian_splatting"] == {
        "kernel": "ellipse", "colorSpace": "srgb_rec709_display", "sortingMethod": "cameraDistance",
        "projection": "perspective",
    }  # fmt: skip
    found = {}
    for name, index in primitive["attributes"].items():
        accessor = document["accessors"][index]
        view = document["bufferViews"][accessor["bufferView"]]
        raw = binary[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]
        found[name] = np.frombuffer(raw, "<f4" if accessor["componentType"] == 5126 else np.uint8).reshape(5, -1)
    prefix = "KHR_gaussian_splatting:"
    np.testing.assert_array_equal(found["POSITION"], g.means)
    np.testing.assert_array_equal(found[prefix + "ROTATION"], g.quats[:, [1, 2, 3, 0]])
    np.testing.assert_array_equal(found[prefix + "SCALE"], g.scales)
    np.testing.assert_array_equal(found[prefix + "OPACITY"][:, 0], g.opacities)
    np.testing.assert_array_equal(found[prefix + "SH_DEGREE_0_COEF_0"], g.sh0[:, 0])
    for n in range(3):
        np.testing.assert_array_equal(found[f"{prefix}SH_DEGREE_1_COEF_{n}"], g.shN[:, n])
    assert set(found) == {"POSITION", "COLOR_0", *(name for name in found if name.startswith(prefix))}
    accessor = document["accessors"][primitive["attributes"]["POSITION"]]
    assert (accessor["min"], accessor["max"]) == (g.means.min(axis=0).tolist(), g.means.max(axis=0).tolist())


def test_the_fallback_color_is_linear_and_its_alpha_the_opacity() -> None:
    gray = (0.5 - 0.5) / SH_C0
    g = Gaussians(np.zeros((3, 3)), [[1, 0, 0, 0]] * 3, np.ones((3, 3)), [0.0, 0.5, 1.0], np.full((3, 1, 3), gray))
    document, binary = glb_parts(encode_glb(g))
    index = document["meshes"][0]["primitives"][0]["attributes"]["COLOR_0"]
    view = document["bufferViews"][document["accessors"][index]["bufferView"]]
    rgba = np.frombuffer(binary[view["byteOffset"] :][:12], np.uint8).reshape(3, 4)
    assert rgba.tolist() == [[55, 55, 55, 0], [55, 55, 55, 128], [55, 55, 55, 255]]  # sRGB 0.5 is 0.214 of the light


@pytest.mark.parametrize("compression", ["none", "spz"])
def test_the_node_turns_the_scene_upright_and_the_reader_follows(tmp_path: Path, compression: Any) -> None:
    g = random_scene(30, 3, 1)
    turn = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # +z up to +y up
    matrix = np.eye(4)
    matrix[:3, :3] = 2.0 * turn
    found = read(tmp_path, encode_glb(g, upright=matrix, compression=compression))
    wanted = read(tmp_path, encode_glb(g, compression=compression)).transform(turn, scale=2.0)
    assert np.abs(found.means - g.means @ (2.0 * turn.T)).max() < 1e-4
    for name in NAMES:
        np.testing.assert_allclose(getattr(found, name), getattr(wanted, name), rtol=1e-5, atol=2e-6)
    np.testing.assert_allclose(found.covars(), wanted.covars(), atol=1e-5)


@pytest.mark.parametrize("degree", [0, 3])
def test_a_compressed_file_rounds_as_spz_does(tmp_path: Path, degree: int) -> None:
    g = random_scene(200, degree, 2)
    save_glb(g, tmp_path / "b.glb", compression="spz")
    again = load_scene(tmp_path / "b.glb")
    assert np.abs(again.means - g.means).max() < 2.0**-16
    assert np.abs(np.log(again.scales / g.scales)).max() <= 1 / 32 + 1e-5
    assert np.abs(again.opacities - g.opacities).max() <= 0.5 / 255 + 1e-6
    assert degree == 0 or np.abs(again.shN - g.shN).max() <= 0.5 / 128 + 1e-6
    turned = np.abs(np.einsum("ni,ni->n", again.quats, g.quats))
    assert turned.min() > 0.99999
    document, _ = glb_parts((tmp_path / "b.glb").read_bytes())
    listed = document["meshes"][0]["primitives"][0]["attributes"]
    assert sum("SH_DEGREE_" in name for name in listed) == (15 if degree else 0)  # CesiumJS counts them
    assert document["extensionsRequired"] == [
        "KHR_gaussian_splatting", "KHR_gaussian_splatting_compression_spz_2",
    ]  # fmt: skip


def test_quantized_values_strides_and_offsets(tmp_path: Path) -> None:
    """Two Gaussians, interleaved, as another program may write them."""
    half = round(0.5**0.5 * 32767)
    rows = b""
    for k in range(2):
        rows += struct.pack("<3f", k, 2 * k, 3) + struct.pack("<4h", half, 0, 0, half)
        rows += struct.pack("<3H2x", 1, 2, 3) + struct.pack("<B3x", 51 * (k + 1)) + struct.pack("<3f", 1, 0, -1)
    kinds = [("VEC3", 5126, 0, False), ("VEC4", 5122, 12, True), ("VEC3", 5123, 20, False)]
    kinds += [("SCALAR", 5121, 28, True), ("VEC3", 5126, 32, False)]
    names = ["POSITION", *(f"KHR_gaussian_splatting:{n}" for n in ("ROTATION", "SCALE", "OPACITY"))]
    names.append("KHR_gaussian_splatting:SH_DEGREE_0_COEF_0")
    splats = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
    primitive = {"mode": 0, "attributes": {name: k for k, name in enumerate(names)},
                 "extensions": {"KHR_gaussian_splatting": splats}}  # fmt: skip
    document = {
        "asset": {"version": "2.0"},
        "buffers": [{"byteLength": 4 + len(rows)}],
        "bufferViews": [{"buffer": 0, "byteOffset": 4, "byteLength": len(rows), "byteStride": 44}],
        "accessors": [
            {"bufferView": 0, "byteOffset": at, "count": 2, "type": kind, "componentType": code, "normalized": norm}
            for kind, code, at, norm in kinds
        ],
        "meshes": [{"primitives": [primitive]}],
        "nodes": [
            {"children": [1], "translation": [0, 0, 10], "rotation": [0, 0.7071067811865476, 0, 0.7071067811865476]},
            {"mesh": 0, "scale": [2, 2, 2]},
        ],
    }
    g = read(tmp_path, glb_bytes(document, bytes(4) + rows))
    np.testing.assert_allclose(g.means, [[6, 0, 10], [6, 4, 8]], atol=1e-5)
    np.testing.assert_allclose(g.scales, [[2, 4, 6]] * 2)
    np.testing.assert_allclose(g.opacities, [0.2, 0.4])
    np.testing.assert_allclose(g.sh0[:, 0], [[1, 0, -1]] * 2)
    quarter = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    about_y = np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])
    wanted = quats_from_rotations((about_y @ quarter)[None])[0]
    assert np.abs(g.quats @ wanted).min() > 0.9999


def test_every_instance_of_a_mesh_counts_and_degrees_are_filled_up(tmp_path: Path) -> None:
    def twice(document: dict[str, Any]) -> None:
        document["nodes"] = [{"mesh": 0}, {"mesh": 0, "translation": [1, 0, 0]}]
        document["scenes"] = [{"nodes": [1, 0]}]

    g = random_scene(4, 1, 5)
    found = read(tmp_path, changed(encode_glb(g), twice))
    np.testing.assert_allclose(found.means, np.concatenate([g.means + np.eye(3)[0], g.means]), atol=1e-6)


def _drop(*keys: Any) -> Any:
    def change(document: dict[str, Any]) -> None:
        place: Any = document
        for key in keys[:-1]:
            place = place[key]
        del place[keys[-1]]

    return change


def _put(value: Any, *keys: Any) -> Any:
    def change(document: dict[str, Any]) -> None:
        place: Any = document
        for key in keys[:-1]:
            place = place[key]
        place[keys[-1]] = value

    return change


MESH = ("meshes", 0, "primitives", 0)
SPLATS = (*MESH, "extensions", "KHR_gaussian_splatting")


@pytest.mark.parametrize(
    ("change", "wanted"),
    [
        (_drop(*MESH, "extensions"), "a mesh with the extension KHR_gaussian_splatting"),
        (_put(4, *MESH, "mode"), "0, points"),
        (_drop(*MESH, "mode"), "0, points"),
        (_put("cone", *SPLATS, "kernel"), "ellipse"),
        (_drop(*MESH, "attributes", "KHR_gaussian_splatting:SH_DEGREE_1_COEF_1"), "all 3 coefficients of degree 1"),
        (_drop(*MESH, "attributes", "KHR_gaussian_splatting:OPACITY"), "OPACITY"),
        (_put(["KHR_draco_mesh_compression"], "extensionsRequired"), "KHR_draco_mesh_compression"),
        (_put([[]], "extensionsRequired"), "[]"),
        (_put({"count": 1}, "accessors", 0, "sparse"), "write it in full"),
        (_put(10**9, "accessors", 0, "count"), "bytes for 1,000,000,000 values"),
        (_put(3, "accessors", 2, "count"), "4 values"),
        (_put(5125, "accessors", 0, "componentType"), "8 or 16 bits"),
        (_put("x.bin", "buffers", 0, "uri"), "pack both into one .glb"),
        (_put(10**9, "bufferViews", 0, "byteLength"), "from byte 0"),
        (_put(99, "accessors", 0, "bufferView"), "an integer from 0"),
        (_put([0, 0], "nodes", 0, "children"), "a node with two"),
        (_put([0], "nodes", 0, "children"), "a node with two"),
        (_put([1, 1, 2], "nodes", 0, "scale"), "one scale above 0"),
        (_put([-1, -1, -1], "nodes", 0, "scale"), "one scale above 0"),
        (_put([0] * 16, "nodes", 0, "matrix"), "one scale above 0"),
        (_put([1e299] * 16, "nodes", 0, "matrix"), "one scale above 0"),
        (_put(7, "scenes", 0, "nodes"), "a list"),
        (_put([7], "scenes", 0, "nodes"), "numbers below 1"),
        (_put([None], "meshes"), "an object"),
    ],
)
def test_what_cannot_be_read_is_refused_in_one_line(tmp_path: Path, change: Any, wanted: str) -> None:
    data = changed(encode_glb(random_scene(4, 1, 0)), change)
    with pytest.raises(FormatError) as caught:
        read(tmp_path, data)
    assert wanted in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_node_that_moves_gaussians_to_infinity_is_refused(tmp_path: Path) -> None:
    g = random_scene(4, 0, 0)
    g = Gaussians(g.means * np.float32(1e20), g.quats, g.scales, g.opacities, g.sh0)
    with pytest.raises(FormatError, match="finite"):
        read(tmp_path, changed(encode_glb(g), _put([1e20] * 3, "nodes", 0, "scale")))


def test_logarithms_of_an_early_draft_are_named(tmp_path: Path) -> None:
    g = random_scene(4, 0, 0)
    document, binary = glb_parts(encode_glb(g))
    index = document["meshes"][0]["primitives"][0]["attributes"]["KHR_gaussian_splatting:SCALE"]
    view = document["bufferViews"][index]
    at = view["byteOffset"]
    logs = np.log(g.scales).astype("<f4").tobytes()
    with pytest.raises(FormatError, match="drafts of the extension stored logarithms"):
        read(tmp_path, glb_bytes(document, binary[:at] + logs + binary[at + len(logs) :]))


def test_a_file_that_is_too_large_is_refused_before_it_is_written() -> None:
    check_size(MOST_BYTES // 61, 0)
    with pytest.raises(ValueError, match="write 3D Tiles"):
        check_size(MOST_BYTES // 60 + 1, 0)
    with pytest.raises(ValueError, match="write 3D Tiles"):
        check_size(MOST_BYTES // 240 + 1, 3)


def test_a_collision_mesh_is_no_scene(tmp_path: Path) -> None:
    document = {"asset": {"version": "2.0"}, "meshes": [{"primitives": [{"attributes": {}}]}], "nodes": [{"mesh": 0}]}
    with pytest.raises(FormatError, match="no scene of Gaussians"):
        read(tmp_path, glb_bytes(document, b""))
