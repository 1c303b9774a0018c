"""Targets: cameras, points of COLMAP, head paths, recorded links."""

from __future__ import annotations

import gzip
import json
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest

from gsvis.abr.traces import load_trace
from gsvis.errors import FormatError
from gsvis.io.cameras import load_cameras
from gsvis.io.points import load_points
from gsvis.io.poses import load_path
from gsvis.io.report_cameras import describe_cameras
from gsvis.scene.cameras import Cameras
from gsvis.scene.points import PointCloud
from tests.fuzz.targets import Case, Target
from tests.io.colmap_files import write_mixed, write_model

__all__ = ["TARGETS"]


def cameras(count: int = 3) -> Cameras:
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, 0, 3] = np.arange(count)
    ks = np.tile(np.array([[50.0, 0, 32], [0, 50, 24], [0, 0, 1]]), (count, 1, 1))
    return Cameras(poses, ks, 64, 48, tuple(f"im{k}.jpg" for k in range(count)))


def files_in(folder: Path) -> Case:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def models(text: bool) -> list[Case]:
    found = []
    cloud = PointCloud(np.arange(15.0).reshape(5, 3), np.full((5, 3), 0.2))
    with TemporaryDirectory() as folder:
        for k, place in enumerate((".", "sparse/0")):
            write_model(Path(folder) / str(k) / place, cameras(), cloud, text=text)
            found.append(files_in(Path(folder) / str(k)))
        write_mixed(Path(folder) / "mixed", cameras(2), [(64, 48), (64, 48)], cloud, text=text)
        found.append(files_in(Path(folder) / "mixed"))
    if text:
        simple = {
            name: data.replace(b"PINHOLE 64 48 50.0 50.0", b"SIMPLE_PINHOLE 64 48 50.0")
            for name, data in found[0].items()
        }
        shared = {**found[0], "images.txt": found[0]["images.txt"].replace(b" 2 im1.jpg", b" 1 im1.jpg")}
        found += [simple, shared]
    return found


def in_model(folder: Path, case: Case) -> None:
    refused = None
    try:
        check_cameras(load_cameras(folder))
    except FormatError as error:
        refused = error
    with pytest.raises(FileNotFoundError):
        load_points(folder / "none")
    with suppress(FormatError, FileNotFoundError):
        load_points(folder / min(case))
    cloud = load_points(folder)
    assert np.isfinite(cloud.means).all()
    if refused is not None:
        raise refused


def check_cameras(found: Cameras) -> None:
    assert np.isfinite(found.viewmats).all()
    assert np.isfinite(found.Ks).all()
    assert len(found) == len(found.names)


def transforms() -> list[Case]:
    pose = np.eye(4).tolist()
    intrinsics = {"fl_x": 50.0, "fl_y": 50.0, "cx": 32.0, "cy": 24.0, "w": 64, "h": 48}
    frames = [{"file_path": f"a{k}.png", "transform_matrix": pose} for k in range(3)]
    made = [
        {**intrinsics, "frames": frames},
        {"camera_angle_x": 0.7, "w": 64, "h": 48, "frames": [{"file_path": "a", "transform_matrix": pose[:3]}]},
        {"frames": [{**intrinsics, **frame} for frame in frames], "camera_model": "OPENCV", "k1": 0.0, "p2": 0},
        {"camera_angle_x": 0.7, "camera_angle_y": 0.6, "w": 64, "h": 48, "frames": frames},
    ]
    return [{"transforms.json": json.dumps(document).encode()} for document in made]


def inria() -> list[Case]:
    entry = {
        "id": 0,
        "img_name": "a",
        "width": 64,
        "height": 48,
        "position": [0.0, 1, 2],
        "rotation": np.eye(3).tolist(),
        "fx": 50.0,
        "fy": 50.0,
    }
    plain = {key: value for key, value in entry.items() if key not in ("img_name", "id")}
    return [{"cameras.json": json.dumps(rows).encode()} for rows in ([entry, {**entry, "img_name": "b"}], [plain])]


def in_cameras(folder: Path, case: Case) -> None:
    """Read cameras by the folder and by each file; what a caller gives wrong is refused."""
    with pytest.raises(FileNotFoundError):
        load_cameras(folder / "none")
    with pytest.raises(ValueError, match="size"):
        load_cameras(folder, size=(3,))  # type: ignore[arg-type]
    for name in case:
        with suppress(FormatError, FileNotFoundError):
            check_cameras(load_cameras(folder / name))
    check_cameras(load_cameras(folder, size=(32, 24)))
    check_cameras(load_cameras(folder))


def reports() -> list[Case]:
    document = {"format": "gsvis-report", "version": 1, "cameras": describe_cameras(cameras())}
    return [{"report.json": json.dumps(document).encode()}]


def in_report(folder: Path, case: Case) -> None:
    (name,) = case
    check_cameras(load_cameras(folder / name))


def poses() -> list[Case]:
    header = "t,x,y,z,qw,qx,qy,qz\n"
    rows = "".join(f"{0.1 * k},{k},0,1.5,1,0,0,0\n" for k in range(6))
    text = (header + rows).encode()
    other = b"\xef\xbb\xbf" + text.replace(b"\n", b"\r\n").replace(b"t,x", b'"t",x')
    return [{"a.csv": text}, {"a.csv": other}, {"a.csv.gz": gzip.compress(text, mtime=0)}]


def recordings() -> list[Case]:
    header = "ViewIndex,FOV1,PositionX,PositionY,PositionZ,QuaternionX,QuaternionY,QuaternionZ,QuaternionW,Timestamp\n"
    rows = "".join(
        f"{eye},0.9,{0.1 * k + 0.06 * eye:.3f},1.6,0,0,0.0,0,1.0,{20 * k + 4 * eye}\n"
        for k in range(8)
        for eye in (0, 1)
    )
    settings = b'Scene_Name,Quaternion,Scale\nroom,"0,0,0,1",2\ntruck,"0.707,0,0,0.707",0.76\n'
    text = (header + rows).encode()
    paused = text.replace(b",140\n", b",90140\n").replace(b",144\n", b",90144\n")
    assert paused != text
    late = header + "".join(  # one frame of twelve repeats the time of the one before it
        f"{eye},0.9,{0.1 * k:.3f},1.6,0,0,0.0,0,1.0,{20 * (4 if k == 5 else k) + 4 * eye}\n"
        for k in range(12)
        for eye in (0, 1)
    )
    alone = (header + "".join(rows.splitlines(keepends=True)[:-1])).encode()
    return [
        {"user1_room.csv": text, "scene_setting.csv": settings},
        {"user1_room.csv": paused, "scene_setting.csv": settings},
        {"user1_room.csv": late.encode(), "scene_setting.csv": settings},
        {"truck/user1_truck.csv.gz": gzip.compress(alone, mtime=0), "scene_setting.csv": settings},
    ]


def in_path(folder: Path, case: Case) -> None:
    name = next((name for name in sorted(case) if "user" in name or name.startswith("a.")), "a.csv")
    with pytest.raises(FormatError, match="folder"):
        load_path(folder)
    found = load_path(folder / name)
    assert np.isfinite(found.positions).all()
    assert (np.diff(found.times) > 0).all()


def traces() -> list[Case]:
    text = "".join(f"{k * 0.5} {1.5 + k % 3}\n" for k in range(8)).encode()
    log = "Timestamp,DL_bitrate,State\n" + "".join(f"2019.12.0{k},{1000 * k},D\n" for k in range(1, 6))
    return [{"a.log": text}, {"a.csv": log.encode()}, {"a.csv.gz": gzip.compress(log.encode(), mtime=0)}]


def in_trace(folder: Path, case: Case) -> None:
    (name,) = case
    found = load_trace(folder / name)
    assert found.period > 0
    assert found.bytes_between(0.0, found.period * 1.5) >= 0
    assert found.time_to_send(1e6, 0.0) >= 0


FILES, IO = "gsvis.files.", "gsvis.io."
_TABLE = (IO + "_table", FILES + "limits")

TARGETS = [
    Target(
        "colmap-binary",
        lambda: models(False),
        in_model,
        (FormatError, FileNotFoundError),
        modules=(IO + "colmap", IO + "views"),
    ),
    Target(
        "colmap-text",
        lambda: models(True),
        in_model,
        (FormatError, FileNotFoundError),
        modules=(IO + "colmap", IO + "views"),
    ),
    Target("transforms", transforms, in_cameras, modules=(IO + "transforms_json", IO + "views", IO + "cameras")),
    Target("inria-cameras", inria, in_cameras, modules=(IO + "inria_cameras", IO + "views", IO + "cameras")),
    Target("report-cameras", reports, in_report, modules=(IO + "report_cameras", IO + "views", IO + "cameras")),
    Target("poses", poses, in_path, kinds={"a.csv.gz": "gzip-text"}, modules=(IO + "poses", *_TABLE)),
    Target("eyenav", recordings, in_path, (FormatError, FileNotFoundError), modules=(IO + "eyenav", *_TABLE)),
    Target("traces", traces, in_trace, modules=(IO + "bandwidth_5g", IO + "bandwidth_text", *_TABLE)),
]
