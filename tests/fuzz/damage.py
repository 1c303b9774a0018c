"""Cases with one deliberate fault each, under right checksums and digests: files of scenes, cameras, photographs.

A run of inputs tries each as it is and then changes it further. They reach checks that a random change seldom meets:
two places that have to change together, a file that is missing, a link, or a number that is wrong but well-formed.
`tests/fuzz/damage_stores.py` and `tests/fuzz/damage_wire.py` hold those of the stores and of the wire.
"""

from __future__ import annotations

import io
import json
import os
import pickle
import re
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
from PIL import Image

from gsvis.scene.points import PointCloud
from tests.fuzz import cameras, scenes, training
from tests.fuzz.mutators import _members, zip_of
from tests.fuzz.targets import Case
from tests.io.colmap_files import write_mixed
from tests.io.scene_files import compressed_ply_bytes, ply_bytes, raw_columns, sog_files, streamed_files
from tests.io.test_checkpoint import splats
from tests.train import photo_files

__all__ = ["DAMAGE"]

LINK, PIPE = "@link", "@pipe"
Damaged = dict[str, Case]


def plys() -> Damaged:
    columns = raw_columns(scenes.SMALL)
    none = {name: values[:0] for name, values in columns.items()}
    wide = {**columns, "scale_0": np.where(np.arange(12) == 3, np.inf, columns["scale_0"])}
    return {"no Gaussian": {"a.ply": ply_bytes(none)}, "a scale without end": {"a.ply": ply_bytes(wide)}}


def packed_plys() -> Damaged:
    data = compressed_ply_bytes(scenes.random_scene(300, 0, 4))
    assert b"element chunk 2\n" in data
    head = re.sub(rb"element (\w+) \d+", rb"element \1 0", data.partition(b"end_header")[0])
    return {
        "no Gaussian": {"a.ply": head + b"end_header\n"},
        "ascii": {"a.ply": data.replace(b"binary_little_endian", b"ascii")},
        "chunks of others": {"a.ply": data.replace(b"element chunk 2\n", b"element chunk 1\n")},
    }


def splat_files() -> Damaged:
    return {"a bare pickle": {"a.splat": pickle.dumps({"splats": [1, 2, 3]}, 2)}}


def webp(pixels: np.ndarray, **options: Any) -> bytes:
    out = io.BytesIO()
    Image.fromarray(pixels).save(out, "WEBP", lossless=True, exact=True, **options)
    return out.getvalue()


def planes() -> Damaged:
    """Planes of a SOG folder that are other pictures, larger ones, or none."""
    good, name = sog_files(scenes.SMALL, 2), "means_l.webp"
    pixels = np.zeros((4, 4, 4), np.uint8)
    extended = bytearray(webp(pixels, xmp=b"<x/>"))
    assert extended[12:16] == b"VP8X"
    extended[24:27] = (99).to_bytes(3, "little")
    large = bytearray(webp(pixels))
    assert large[12:16] == b"VP8L"
    large[21:25] = (0x3FFF | 0x3FFF << 14).to_bytes(4, "little")
    frames = [Image.fromarray(pixels + 60 * k) for k in range(3)]
    changed = {
        "an animation": webp(pixels, save_all=True, append_images=frames),
        "a canvas of another size": bytes(extended),
        "too many pixels": bytes(large),
    }
    found = {name_: {**good, name: data} for name_, data in changed.items()}
    rest = {key: data for key, data in good.items() if key != name}
    found["a folder in place of a plane"] = {**rest, f"{name}/x": b""}
    if os.name == "posix":
        found["a link that leads out"] = {**rest, name + LINK: b"/etc/hostname"}
        found["a pipe in place of a plane"] = {**rest, name + PIPE: b""}
    return found


def streams() -> Damaged:
    case = streamed_files({0: scenes.SMALL, 1: scenes.SMALL[:5]})
    around = scenes.streams()[2]
    meta = json.loads(case["lod-meta.json"])

    def changed(**changes: Any) -> Case:
        return {**case, "lod-meta.json": json.dumps({**meta, **changes}).encode()}

    def runs(*pairs: tuple[int, int]) -> Case:
        leaves = [{"lods": {"0": {"file": 0, "offset": a, "count": b}}} for a, b in pairs]
        return changed(tree={"children": leaves})

    return {
        "no file at all": {"lod-meta.json": case["lod-meta.json"]},
        "no environment": {name: data for name, data in around.items() if name != "env/meta.json"},
        "a file named twice": changed(filenames=[meta["filenames"][0]] * 2),
        "a run behind the end": runs((0, 5), (5, 90)),
        "runs that overlap": runs((0, 7), (5, 7)),
        "nothing in any run": runs((0, 0)),
        "JSON of something else": {"other.json": b'{"a": 1}'},
    }


def saved(content: Any, **members: bytes) -> Case:
    """What torch saves of a value, with other bytes in some of its entries."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "a.pt"
        torch.save(content, path)
        entries = _members(path.read_bytes()) or {}
    for name in list(entries):
        if name.partition("/")[2].replace(".", "_") in members:
            entries[name] = members[name.partition("/")[2].replace(".", "_")]
    return {"a.pt": zip_of(entries)}


def checkpoints() -> Damaged:
    state = dict(splats(6, 1).state_dict())
    whole = saved({"splats": state})["a.pt"]
    entries = _members(whole) or {}
    other = {k: v.replace(b"storage", b"storagf") if k.endswith(".pkl") else v for k, v in entries.items()}
    lost = {k: v for k, v in entries.items() if not k.endswith(".pkl")}
    return {
        "no means": saved({"splats": {"x": state["means"]}}),
        "no scales": saved({"splats": {"means": state["means"]}}),
        "no Gaussian": saved({"splats": {name: value[:0] for name, value in state.items()}}),
        "a list": saved([1, 2, 3]),
        "a tuple": saved((state, 30_000)),
        "whole numbers": saved({"splats": {**state, "means": state["means"].long()}}),
        "a large structure": saved({"splats": state, "note": "x" * 600_000}),
        "a reference to something else": {"a.pt": zip_of(other)},
        "no structure": {"a.pt": zip_of(lost)},
        "a memo that promises memory": saved({"splats": state}, data_pkl=b"\x80\x02}r\xff\xff\xff\x7f."),
    }


def point_files() -> Damaged:
    columns = {**dict(zip("xyz", np.zeros((3, 4)), strict=True)), "red": np.zeros(4), "green": np.zeros(4)}
    colors = {**columns, "blue": np.zeros(4)}
    kinds = {"red": "u1", "green": "u2", "blue": "u1"}
    no_rows = ply_bytes(colors).replace(b"element vertex", b"element virtex")
    return {
        "two colors": {"points3D.ply": ply_bytes(columns, types=dict.fromkeys(("red", "green"), "u1"))},
        "colors of two types": {"points3D.ply": ply_bytes(colors, types=kinds)},
        "no vertex": {"points3D.ply": no_rows},
    }


def camera_files() -> Damaged:
    (whole, *_), (inria, *_) = cameras.transforms(), cameras.inria()
    rows = json.loads(inria["cameras.json"])
    frames = {key: value for key, value in json.loads(whole["transforms.json"]).items() if key not in ("fl_x", "fl_y")}
    return {
        "a name that is none": {"cameras.json": json.dumps([{**rows[0], "img_name": 7}]).encode()},
        "no focal length": {"transforms.json": json.dumps(frames).encode()},
        "another file": {"cameras.dat": b"\0\1\2"},
        "a model of nothing": {"cameras.txt": b"", "images.txt": b""},
    }


def recordings() -> Damaged:
    recording, settings = (cameras.recordings()[0][name] for name in ("user1_room.csv", "scene_setting.csv"))
    header = recording.partition(b"\n")[0] + b"\n"
    return {
        "a scale of 0": {"user1_room.csv": recording, "scene_setting.csv": settings.replace(b",2\n", b",0\n")},
        "no pose": {"user1_room.csv": header, "scene_setting.csv": settings},
        "no time": {"user1_room.csv": recording.replace(b",Timestamp", b",Time"), "scene_setting.csv": settings},
    }


def traces() -> Damaged:
    return {
        "no row": {"a.csv": b"Timestamp,DL_bitrate,State\n"},
        "a rate below 0": {"a.csv": b"Timestamp,DL_bitrate,State\n1,5,D\n2,-1,D\n"},
        "a rate that is enormous": {"a.log": b"0 1\n1 1e12\n2 1\n"},
    }


def photographs() -> Damaged:
    with TemporaryDirectory() as name:
        root = Path(name)
        for k in range(3):
            (root / str(k)).mkdir()
        model = cameras.files_in(photo_files.write_photos(root / "0", training.PHOTOS))
        few = cameras.files_in(photo_files.write_photos(root / "1", training.PHOTOS - 1))
        bare = cameras.files_in(photo_files.write_transforms(root / "2", training.PHOTOS, sizes=False))
        cloud = PointCloud(np.zeros((2, 3)), np.zeros((2, 3)))
        sizes = [(48, 32)] * 4 + [(32, 48)] * 4
        write_mixed(root / "3" / "sparse" / "0", photo_files.cameras(training.PHOTOS), sizes, cloud)
        mixed = cameras.files_in(root / "3")
    images = sorted(path for path in model if path.endswith(".png"))
    said = json.loads(bare["transforms.json"])

    def shaped(case: Case, side: tuple[int, int]) -> Case:
        picture = training.stored(Image.new("RGB", side, (9, 90, 200)))
        return {path: picture if path.endswith(".png") else data for path, data in case.items()}

    def case(content: Any) -> Case:
        return {**bare, "transforms.json": json.dumps(content).encode()}

    first = {**said["frames"][0], "file_path": 7}
    tiny = json.loads(json.dumps(said)) | {"w": 8, "h": 8}
    return {
        "seven photographs": few,
        "a list": case([said]),
        "a name that is none": case({**said, "frames": [first, *said["frames"][1:]]}),
        "no image": {path: data for path, data in model.items() if not path.endswith(".png")},
        "turned images": shaped(model, (photo_files.HEIGHT, photo_files.WIDTH)),
        "images of nothing": shaped(case(said | {"w": 48 * 100, "h": 32 * 100}), (48, 32)),
        "tiny images": shaped(case(tiny), (8, 8)),
        "images of two sizes": {
            **mixed,
            **{
                path: training.stored(Image.new("RGB", side, (9, 90, 200)))
                for path, side in zip(images, sizes, strict=True)
            },
        },
    }


DAMAGE = {
    "ply": plys,
    "compressed-ply": packed_plys,
    "splat": splat_files,
    "sog-folder": planes,
    "streamed-sog": streams,
    "trained": checkpoints,
    "points": point_files,
    "inria-cameras": camera_files,
    "eyenav": recordings,
    "traces": traces,
    "photographs": photographs,
}
"""What makes the damaged cases of a target, by its name."""
