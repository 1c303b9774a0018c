"""Cases with one deliberate fault each, in the JSON of a format: a place that holds another value, sealed anew."""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Callable
from typing import Any

import numpy as np

from gsvis.io._gltf import SPLATS
from gsvis.package.manifest import MANIFEST
from gsvis.scene.content import scene_hash
from gsvis.world.manifest import WORLD
from tests.fuzz import cameras, edits, packages, scenes
from tests.fuzz.containers import sealed_manifest
from tests.fuzz.damage import Damaged
from tests.fuzz.places import DROP, cases_of
from tests.fuzz.targets import Case
from tests.io.scene_files import glb_bytes, glb_parts, random_scene, streamed_files
from tests.world.manifests import example

__all__ = ["DAMAGE"]


def plain(name: str, rest: Case | None = None) -> Callable[[Any], Case]:
    """How a document becomes a case: as JSON under a name, beside other files."""
    return lambda document: {**(rest or {}), name: json.dumps(document).encode()}


def worlds() -> Damaged:
    faults = {
        "a newer version": {"version": 3},
        "an older version": {"version": 1},
        "an axis that is no unit": {"up": [0, 0, 2]},
        "meters below 0": {"meters_per_unit": -1.0},
        "no tile": {"tiles": []},
        "axes in another order": {"grid.axes": [1, 0]},
        "a side of 0": {"grid.side": 0.0},
        "too many squares": {"grid.shape": [1 << 22, 2]},
        "a tile beyond the grid": {"tiles.1.shape": [3, 1]},
        "a tile without levels": {"tiles.0.levels": []},
        "a tile of other levels": {"tiles.0.levels": [{"name": f"n{k}", "count": 1} for k in range(17)]},
        "a tile that sees itself beyond it": {"tiles.0.beyond.pieces.0.node": 0},
        "a tile in two nodes": {"tiles.0.beyond.pieces.0.node": 4},
        "runs that go back": {"tiles.0.beyond.pieces.0.runs": [[0, 4], [2, 2]]},
        "a run of nothing": {"tiles.0.beyond.pieces.0.runs": [[0, 0]]},
        "an id in two pieces": {"tiles.0.beyond.pieces.1.runs": [[3, 2]]},
        "tiles in another order": {"tiles.1.coords": [0, 0]},
        "what lies outside before the last": {"tiles.1.coords": None},
        "tiles on one square": {"tiles.0.shape": [2, 1]},
        "a district of other tiles": {"districts.0.tiles": [1]},
        "a district of tiles and districts": {"districts.2.children": [0, 4]},
        "a node of two districts": {"districts.1.children": [0], "districts.1.tiles": [0]},
        "a box inside out": {"tiles.0.low": [5.0, 5.0, 5.0]},
    }
    return cases_of(json.loads(example().to_json()), faults, lambda document: {WORLD: sealed_manifest(document)})


def manifests() -> Damaged:
    near = json.loads(packages.manifests()[-1][MANIFEST])
    faults = {
        "fidelity of no view": {"fidelity.poses": []},
        "a field of view of 0": {"fidelity.fov": 0.0},
        "a turn that is none": {"fidelity.poses.0.rotation": [0.0, 0.0, 0.0, 2.0]},
        "an epsilon below 0": {"epsilon": -1.0},
        "an axis of 0": {"up": [0.0, 0.0, 0.0]},
        "a scene that is none": {"scene": 7},
    }
    return cases_of(near, faults, lambda document: {MANIFEST: sealed_manifest(document)})


def gltfs() -> Damaged:
    whole = scenes.gltfs()[0]["a.glb"]
    document, binary = glb_parts(whole)
    accessor = {name: f"accessors.{number}" for name, number in
                document["meshes"][0]["primitives"][0]["attributes"].items()}  # fmt: skip
    scale, opacity, here = accessor[f"{SPLATS}:SCALE"], accessor[f"{SPLATS}:OPACITY"], "meshes.0.primitives.0"
    stretch = np.diag([1.0, 2.0, 3.0, 1.0])
    faults = {
        "an extension that is unknown": {"extensionsRequired": ["KHR_draco_mesh_compression"]},
        "an extension that is no name": {"extensionsRequired": [7]},
        "no Gaussians": {f"{here}.extensions": DROP},
        "no mesh": {"meshes": [], "nodes": [{}]},
        "triangles": {f"{here}.mode": 4},
        "no mode": {f"{here}.mode": DROP},
        "another kernel": {f"{here}.extensions.{SPLATS}.kernel": "box"},
        "32-bit integers": {f"{scale}.componentType": 5125},
        "a sparse accessor": {f"{scale}.sparse": {"count": 1}},
        "more values than bytes": {f"{scale}.count": 13},
        "a stride below a value": {"bufferViews.2.byteStride": 8},
        "no view of a buffer": {f"{scale}.bufferView": DROP},
        "bytes of another file": {"buffers.0.uri": "a.bin"},
        "another buffer": {"buffers.1": {"byteLength": 9}, "bufferViews.2.buffer": 1},
        "a view beyond the chunk": {"bufferViews.2.byteOffset": 4000},
        "no accessors": {"accessors": []},
        "fewer of one attribute": {f"{opacity}.count": 11},
        "a coefficient that is missing": {f"{here}.attributes.{SPLATS}:SH_DEGREE_1_COEF_1": DROP},
        "opacities above 1": {f"{opacity}.componentType": 5121},
        "a node named twice": {"scenes.0.nodes": [0, 0]},
        "a node that is not there": {"scenes.0.nodes": [7]},
        "a node that is its own child": {"nodes.0.children": [0]},
        "a turn that is none": {"nodes.0.rotation": [0.0, 0.0, 0.0, 3.0]},
        "a scale for each axis": {"nodes.0.scale": [1.0, 2.0, 3.0]},
        "a matrix that stretches": {"nodes.0.matrix": stretch.ravel().tolist()},
        "a matrix that mirrors": {"nodes.0.matrix": np.diag([-1.0, 1.0, 1.0, 1.0]).ravel().tolist()},
        "a matrix of zeros": {"nodes.0.matrix": [0.0] * 16},
        "a shift without end": {"nodes.0.translation": [1e300, 0.0, 0.0]},
    }
    view = document["bufferViews"][document["accessors"][int(scale.partition(".")[2])]["bufferView"]]
    below = bytearray(binary)
    struct.pack_into("<f", below, view["byteOffset"], -1.0)
    return cases_of(document, faults, lambda found: {"a.glb": glb_bytes(found, binary)}) | {
        "a scale below 0": {"a.glb": glb_bytes(document, bytes(below))},
        "glTF of version 1": {"a.glb": whole[:4] + struct.pack("<I", 1) + whole[8:]},
        "another length": {"a.glb": whole[:8] + struct.pack("<I", len(whole) - 4) + whole[12:]},
        "a chunk beyond the end": {"a.glb": whole[:12] + struct.pack("<I", 1 << 20) + whole[16:]},
        "a binary chunk first": {"a.glb": whole[:16] + b"BIN\0" + whole[20:]},
    }


def streams() -> Damaged:
    case = streamed_files({0: scenes.SMALL, 1: scenes.SMALL[:5]})
    leaf = {"lods": {"zero": {"file": 0, "offset": 0, "count": 5}}}
    return cases_of(
        json.loads(case["lod-meta.json"]), {"a level that is no number": {"tree": leaf}}, plain("lod-meta.json", case)
    )


def transforms() -> Damaged:
    document = json.loads(cameras.transforms()[0]["transforms.json"])
    pose, far = document["frames"][0]["transform_matrix"], np.eye(4)
    far[0, 3] = math.inf
    faults = {
        "a lens that bends": {"k1": 0.2},
        "a fisheye": {"camera_model": "OPENCV_FISHEYE"},
        "no size": {"w": DROP},
        "a focal length of 0": {"fl_x": 0.0},
        "a focal length without end": {"fl_x": math.inf},
        "no focal length": {"fl_x": DROP, "fl_y": DROP},
        "a field of view of a turn": {"fl_x": DROP, "camera_angle_x": 7.0},
        "a size of 0": {"w": 0},
        "a pose that is stretched": {"frames.0.transform_matrix": [[2 * value for value in row] for row in pose]},
        "a pose that mirrors": {"frames.0.transform_matrix": np.diag([-1.0, 1, 1, 1]).tolist()},
        "a pose without end": {"frames.0.transform_matrix": far.tolist()},
        "a pose of two axes": {"frames.0.transform_matrix": [[1, 0], [0, 1]]},
        "a pose of words": {"frames.0.transform_matrix": "eye"},
        "a frame that is a number": {"frames.0": 7},
        "a name that is a number": {"frames.0.file_path": 7},
        "no frame": {"frames": []},
    }
    # `in_cameras` reads with a size and without: without one, "no size" is refused
    return cases_of(document, faults, plain("transforms.json"))


def reports() -> Damaged:
    document = json.loads(cameras.reports()[0]["report.json"])
    faults: dict[str, dict[str, Any]] = {
        "no cameras": {"cameras": DROP},
        "cameras that are a number": {"cameras": 7},
        "a camera that is a number": {"cameras.0": 7},
        "a name that is a number": {"cameras.0.name": 7},
        "a matrix that is stretched": {"cameras.0.viewmat.0.0": 2.0},
        "a matrix of another last row": {"cameras.0.viewmat.3": [0, 0, 1, 1]},
        "a focal length below 0": {"cameras.0.K.0.0": -50.0},
    }
    return cases_of(document, faults, plain("report.json"))


def voxels() -> Damaged:
    (first, *_) = edits.voxel_files()
    document = json.loads(first["a.voxel.json"])
    faults = {
        "a corner without end": {"gridBounds.min.0": math.inf},
        "a side of 0": {"voxelResolution": 0.0},
        "blocks of 8": {"leafSize": 8},
        "a depth of 40": {"treeDepth": 40},
        "a depth that is none": {"treeDepth": 2.0},
        "nodes below 0": {"nodeCount": -1},
        "half a block": {"leafDataCount": 3},
        "a box of no whole blocks": {
            "gridBounds.max.0": document["gridBounds"]["max"][0] + document["voxelResolution"]
        },
        "no count of nodes": {"nodeCount": DROP},
    }
    return edits.damaged_voxels() | cases_of(document, faults, plain("a.voxel.json", first))


def selections() -> Damaged:
    case = edits.selections()[0]
    note = json.loads(case["a.json"])
    faults = {"a selection of another scene": {"scene": scene_hash(random_scene(12, 0, 2))}}
    found = edits.damaged_selections() | cases_of(note, faults, plain("a.json", case))
    for what, numbers in (
        ("one more", np.zeros(13, np.uint8)),
        ("numbers above 255", np.full(12, 256)),
        ("far too many", np.zeros(70_000, np.uint8)),
        ("fractions", np.zeros(12)),
    ):
        found[what] = {"a.npy": edits.saved(numbers)}
    whole, types = edits.saved(np.zeros(12, np.uint8)), (b"()", b"('|u1',)", b"'f8,('", b"-" * 3000 + b"1")
    for k, other in enumerate(types):  # the header is Python, which NumPy parses
        head = whole[10:].partition(b"\n")[0].rstrip().replace(b"'|u1'", other) + b"\n"
        found[f"a type that is none, {k}"] = {"a.npy": whole[:8] + struct.pack("<H", len(head)) + head + bytes(12)}
    return found


def inria() -> Damaged:
    document = json.loads(cameras.inria()[0]["cameras.json"])
    faults: dict[str, dict[str, Any]] = {
        "a turn of zeros": {"0.rotation": np.zeros((3, 3)).tolist()},
        "a place without end": {"0.position.0": math.inf},
        "a side of a billion": {"0.width": 10**9},
        "an entry that is a number": {"0": 7},
    }
    return cases_of(document, faults, plain("cameras.json"))


DAMAGE = {
    "world": worlds,
    "manifest": manifests,
    "glb": gltfs,
    "streamed-sog": streams,
    "transforms": transforms,
    "report-cameras": reports,
    "inria-cameras": inria,
    "voxels": voxels,
    "selection": selections,
}
"""What makes the damaged cases of a target, by its name."""
