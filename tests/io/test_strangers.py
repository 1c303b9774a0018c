"""What people point gsvis at by mistake: each is read, or refused in one line that says what to do."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from gsvis.errors import FormatError
from gsvis.io import load_cameras, load_points, load_scene, save_scene
from gsvis.scene.cameras import Cameras
from gsvis.scene.procedural import two_rooms
from tests.io.colmap_files import write_model

MESH = """ply
format ascii 1.0
element vertex 3
property float x
property float y
property float z
element face 1
property list uchar int vertex_indices
end_header
0 0 0
1 0 0
0 1 0
3 0 1 2
"""


def refusal(call: Callable[[], object]) -> str:
    with pytest.raises(FormatError) as caught:
        call()
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.fixture
def ply(tmp_path: Path) -> Path:
    save_scene(two_rooms().gaussians[:50], tmp_path / "files" / "scene.ply")
    return tmp_path / "files" / "scene.ply"


@pytest.mark.parametrize("name", ["scene.splat", "scene.spz", "scene.sog", "scene.txt", "scene"])
def test_content_counts_and_not_the_suffix(ply: Path, name: str) -> None:
    assert len(load_scene(shutil.copy(ply, ply.with_name(name)))) == 50


@pytest.mark.parametrize("suffix", [".ply", ".splat", ".ksplat", ".spz", ".sog", ".pt", ".ckpt", ".txt"])
def test_an_empty_file_is_called_so(tmp_path: Path, suffix: str) -> None:
    (tmp_path / f"scene{suffix}").touch()
    text = refusal(lambda: load_scene(tmp_path / f"scene{suffix}"))
    assert "got an empty file; was the download or the export interrupted?" in text


@pytest.mark.parametrize(
    ("text", "kind"),
    [
        (MESH, "mesh"),
        (MESH.replace("property float z", "property float z\nproperty float nx\nproperty uchar red"), "mesh"),
        (MESH.replace("element vertex", "element face 0\nproperty list uchar int i\nelement vertex", 1)
         .replace("element face 1\nproperty list uchar int vertex_indices\n", ""), "mesh"),
        (MESH.replace("element face 1\nproperty list uchar int vertex_indices\n", ""), "point cloud"),
    ],
)  # fmt: skip
def test_a_ply_of_another_kind_is_called_by_its_name(tmp_path: Path, text: str, kind: str) -> None:
    (tmp_path / "a.ply").write_text(text, encoding="ascii")
    assert f"this PLY is a {kind}, not a trained scene" in refusal(lambda: load_scene(tmp_path / "a.ply"))


def test_a_ply_of_gaussians_that_lacks_something_is_not_called_a_mesh(ply: Path) -> None:
    header = ply.read_bytes().replace(b"property float opacity\n", b"property float opacify\n")
    ply.write_bytes(header)
    text = refusal(lambda: load_scene(ply))
    assert text.endswith("got no opacity")


def test_further_properties_of_a_ply_are_passed_over(ply: Path, tmp_path: Path) -> None:
    whole = ply.read_bytes()
    at = whole.index(b"end_header\n")
    rows = np.frombuffer(whole[at + 11 :], np.uint8).reshape(50, -1)
    further = np.hstack([rows, np.zeros((50, 9), np.uint8)])
    header = whole[:at] + b"property uchar semantic\nproperty double confidence\nend_header\n"
    (tmp_path / "more.ply").write_bytes(header + further.tobytes())
    assert np.array_equal(load_scene(tmp_path / "more.ply").means, load_scene(ply).means)


@pytest.mark.parametrize(
    ("places", "asked", "meant"),
    [
        (["a.ply"], "", "a.ply"),
        (["scan/input.ply", "scan/point_cloud/iteration_7000/point_cloud.ply",
          "scan/point_cloud/iteration_30000/point_cloud.ply"], "scan",
         "scan/point_cloud/iteration_30000/point_cloud.ply (of 2)"),
        (["ckpts/ckpt_6999_rank0.pt", "ckpts/ckpt_29999_rank0.pt", "cfg.yml"], "", "ckpts/ckpt_29999_rank0.pt (of 2)"),
        (["n/config.yml", "n/dataparser_transforms.json", "n/nerfstudio_models/step-000029999.ckpt"], "n",
         "n/nerfstudio_models/step-000029999.ckpt"),
        (["n/config.yml", "n/nerfstudio_models/step-000029999.ckpt"], "n/config.yml",
         "n/nerfstudio_models/step-000029999.ckpt"),
        (["some/lod-meta.json"], "", "some/lod-meta.json"),
    ],
)  # fmt: skip
def test_a_folder_gets_the_file_that_was_meant(tmp_path: Path, places: list[str], asked: str, meant: str) -> None:
    folder = tmp_path / "run"
    for place in places:
        (folder / place).parent.mkdir(parents=True, exist_ok=True)
        (folder / place).write_text("x", encoding="ascii")
    text = refusal(lambda: load_scene(folder / asked))
    assert text.endswith(f"; name a file in it, such as {folder / meant}")


def test_json_that_is_no_scene_says_what_it_holds(tmp_path: Path) -> None:
    (tmp_path / "dataparser_transforms.json").write_text(json.dumps({"transform": [], "scale": 1.0}), encoding="ascii")
    text = refusal(lambda: load_scene(tmp_path / "dataparser_transforms.json"))
    assert "expected a scene" in text
    assert "got JSON with keys transform, scale" in text


def test_photographs_are_no_scene_and_a_model_may_lie_deeper(tmp_path: Path, ply: Path) -> None:
    model = tmp_path / "data" / "garden" / "sparse" / "0"
    write_model(model, Cameras.orbit((0, 0, 0), 1.0, 3))
    garden = tmp_path / "data" / "garden"
    for folder in (tmp_path / "data", garden):
        assert f"cameras of photographs are in {garden}: gsvis train" in refusal(lambda f=folder: load_scene(f))
    assert f"name the folder of one model, such as {garden}" in refusal(lambda: load_cameras(tmp_path / "data"))
    assert f"name the folder of one model, such as {garden}" in refusal(lambda: load_points(tmp_path / "data"))
    assert len(load_cameras(garden)) > 0
    assert "expected a COLMAP model" in refusal(lambda: load_cameras(ply))
    (tmp_path / "none").mkdir()
    assert refusal(lambda: load_cameras(tmp_path / "none")).endswith("got a folder without any of them")


def test_the_search_in_a_folder_ends(tmp_path: Path) -> None:
    deep = tmp_path / "a" / "b" / "c" / "d" / "e" / "f"
    deep.mkdir(parents=True)
    (deep / "scene.ply").touch()
    (tmp_path / "a" / "loop").symlink_to(tmp_path)
    assert "name a file" not in refusal(lambda: load_scene(tmp_path))
