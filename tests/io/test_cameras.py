"""`load_cameras`: which format a file has, one image size, and what real reconstructions give."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gsvis.errors import FormatError
from gsvis.io.cameras import load_cameras


def frame(name: str, **extra: Any) -> dict[str, Any]:
    return {"file_path": name, "transform_matrix": np.eye(4).tolist(), **extra}


def write_transforms(path: Path, frames: list[dict[str, Any]], **top: Any) -> Path:
    path.write_text(json.dumps({"w": 640, "h": 480, "fl_x": 500.0, **top, "frames": frames}))
    return path


def test_a_folder_is_searched_for_every_format(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match="without any of them"):
        load_cameras(tmp_path)
    write_transforms(tmp_path / "transforms.json", [frame("a")])
    assert load_cameras(tmp_path).names == ("a",)
    model = tmp_path / "sparse" / "0"
    model.mkdir(parents=True)
    (model / "cameras.txt").write_text("1 PINHOLE 64 48 50 50 32 24\n")
    (model / "images.txt").write_text("1 1 0 0 0 0 0 0 1 from colmap.jpg\n\n")
    for path in (tmp_path, tmp_path / "sparse", model, model / "images.txt"):
        assert load_cameras(path).names == ("from colmap.jpg",)


def test_names_are_sorted_whatever_the_order_in_the_file(tmp_path: Path) -> None:
    moved = np.eye(4)
    moved[0, 3] = 5.0
    frames = [frame("b"), {"file_path": "a", "transform_matrix": moved.tolist()}]
    cameras = load_cameras(write_transforms(tmp_path / "t.json", frames))
    assert cameras.names == ("a", "b")
    np.testing.assert_allclose(cameras.viewpoints, [[5, 0, 0], [0, 0, 0]])


def test_mixed_sizes_are_named_and_rescaled_on_request(tmp_path: Path) -> None:
    path = write_transforms(tmp_path / "t.json", [frame("a"), frame("b", w=320, h=240, fl_x=250.0)])
    with pytest.raises(FormatError, match=r"320 x 240, 640 x 480; .*size=\(width, height\) or --width and --height"):
        load_cameras(path)
    cameras = load_cameras(path, size=(160, 120))
    np.testing.assert_allclose(cameras.Ks, [[[125, 0, 80], [0, 125, 60], [0, 0, 1]]] * 2)
    assert (cameras.width, cameras.height) == (160, 120)


def test_rescaling_keeps_the_rays_through_the_image_corners(tmp_path: Path) -> None:
    path = write_transforms(tmp_path / "t.json", [frame("a", cx=300.0, cy=250.0, fl_y=450.0)])
    for size in ((640, 480), (64, 96)):
        k = load_cameras(path, size=size).Ks[0]
        corners = np.linalg.solve(k, [[0, size[0]], [0, size[1]], [1, 1]])
        np.testing.assert_allclose(corners[:2], [[-0.6, 340 / 500], [-250 / 450, 230 / 450]])


@pytest.mark.parametrize("size", [(0, 5), (5,), 7, (5.0, 5), "ab"])
def test_a_bad_size_names_itself(tmp_path: Path, size: Any) -> None:
    with pytest.raises(ValueError, match=r"^size"):
        load_cameras(tmp_path, size=size)


@pytest.mark.parametrize("text", ["", "{", "3", '"x"', "[" * 100_000, "1" * 10_000, "\udcff"])
def test_what_is_no_camera_file_says_so(tmp_path: Path, text: str) -> None:
    path = tmp_path / "x.json"
    path.write_bytes(text.encode(errors="surrogateescape"))
    with pytest.raises(FormatError, match="expected"):
        load_cameras(path)


def test_a_missing_file_says_so(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"no camera file or folder here.*nothing\.json"):
        load_cameras(tmp_path / "nothing.json")


@pytest.mark.realdata
def test_bonsai_reprojects_its_own_points(realdata: Path) -> None:
    """Seen by our cameras, COLMAP's points miss their keypoints by what COLMAP itself recorded: 0.43 px in the mean."""
    model = realdata / "photos" / "bonsai" / "sparse" / "0"
    cameras = load_cameras(realdata / "photos" / "bonsai")
    assert (len(cameras), cameras.width, cameras.height) == (292, 798, 531)
    assert cameras.names[0] == "DSCF5565.JPG"
    points = read_points(model / "points3D.bin")
    misses: dict[int, list[float]] = {number: [] for number in points}
    for name, keypoints, ids in read_keypoints(model / "images.bin"):
        i = cameras.names.index(name)
        world = np.stack([points[j][0] for j in ids])
        local = world @ cameras.viewmats[i, :3, :3].T + cameras.viewmats[i, :3, 3]
        assert (local[:, 2] > 0).all()
        pixels = local @ cameras.Ks[i].T
        for j, miss in zip(ids, np.linalg.norm(pixels[:, :2] / pixels[:, 2:] - keypoints, axis=1), strict=True):
            misses[j].append(miss)
    mean = np.array([np.mean(misses[j]) for j in points])
    recorded = np.array([error for _, error in points.values()])
    assert len(points) == 51_939
    assert mean.mean() == pytest.approx(0.43, abs=0.005)
    assert np.median(np.abs(mean - recorded)) < 0.002


def read_points(path: Path) -> dict[int, tuple[list[float], float]]:
    """Position and recorded error by id; a plain reader of COLMAP's points3D.bin, independent of the library's."""
    data = path.read_bytes()
    at, points = 8, {}
    for _ in range(struct.unpack_from("<Q", data)[0]):
        number, *xyz = struct.unpack_from("<Q3d", data, at)
        error, track = struct.unpack_from("<dQ", data, at + 35)
        points[number] = (xyz, error)
        at += 51 + 8 * track
    return points


def read_keypoints(path: Path) -> list[tuple[str, np.ndarray, np.ndarray]]:
    """Name, (M, 2) keypoints and (M,) point ids of each image; a plain reader of COLMAP's images.bin."""
    data = path.read_bytes()
    at, images = 8, []
    for _ in range(struct.unpack_from("<Q", data)[0]):
        end = data.index(b"\0", at + 64)
        name = data[at + 64 : end].decode()
        (number,) = struct.unpack_from("<Q", data, end + 1)
        record = np.dtype([("xy", "<f8", 2), ("id", "<i8")])
        keypoints = np.frombuffer(data, record, number, end + 9)
        keypoints = keypoints[keypoints["id"] >= 0]
        images.append((name, keypoints["xy"], keypoints["id"]))
        at = end + 9 + 24 * number
    return images


FOREIGN = {
    "metashape.xml": ('<?xml version="1.0"?>\n<document version="2.0.0">\n  <chunk label="a"/>', "Metashape"),
    "blocks.xml": ('<?xml version="1.0"?>\n<BlocksExchange version="3.2">', "BlocksExchange"),
    "bundle.out": ("# Bundle file v0.3\n2 0\n", "Bundler"),
    "cameras.nvm": ("NVM_V3\n\n2\n", "VisualSFM"),
    "registration.csv": ("#cameras 24\n#name,x,y,alt,heading,pitch,roll\na.jpg,1,2,3,4,5,6\n", "RealityCapture"),
    "named.csv": ("#name,x,y,z,heading,pitch,roll\n", "RealityCapture"),
    "a.xmp": ('<x:xmpmeta><rdf:Description xcr:Version="3"/></x:xmpmeta>', "RealityCapture"),
    "scene.rcalign": ("\0\1", "RealityCapture"),
    "scene.psx": ("<document/>", "Metashape"),
    "sfm_data.json": ('{"sfm_data_version": "0.3", "views": []}', "OpenMVG"),
    "cameras.sfm": ('{"version": ["1"], "views": [], "intrinsics": [], "poses": []}', "Meshroom"),
    "reconstruction.json": ('[{"cameras": {}, "shots": {}, "points": {}}]', "OpenSfM"),
}


@pytest.mark.parametrize("name", FOREIGN)
def test_cameras_of_other_programs_are_named_with_the_way_to_a_colmap_model(tmp_path: Path, name: str) -> None:
    text, program = FOREIGN[name]
    (tmp_path / name).write_text(text)
    with pytest.raises(FormatError, match=program) as refused:
        load_cameras(tmp_path / name)
    assert "COLMAP" in str(refused.value).partition(program)[2]
    assert "\n" not in str(refused.value)


def test_a_folder_of_other_cameras_names_the_file(tmp_path: Path) -> None:
    (tmp_path / "cameras.xml").write_text(FOREIGN["metashape.xml"][0])
    with pytest.raises(FormatError, match=r"Metashape \(XML\): cameras.xml; export them as a COLMAP model"):
        load_cameras(tmp_path)


@pytest.mark.parametrize("name", ["transforms.json", "cameras.json", "images.txt", "images.bin"])
def test_a_pointer_of_git_lfs_is_named(tmp_path: Path, name: str) -> None:
    (tmp_path / f"cameras{Path(name).suffix}").write_bytes(b"" if name.endswith(".txt") else bytes(8))
    (tmp_path / name).write_text("version https://git-lfs.github.com/spec/v1\noid sha256:00\nsize 3\n")
    with pytest.raises(FormatError, match="Git LFS pointer, not the file; run git lfs pull"):
        load_cameras(tmp_path / name)
