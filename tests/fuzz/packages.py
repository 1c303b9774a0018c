"""Targets: manifests and whole packages, whose parts are changed and named by their new hash."""

from __future__ import annotations

import hashlib
import json
import zipfile
from pathlib import Path
from random import Random
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pytest

from gsvis.errors import FormatError, SceneError
from gsvis.package import Package, decode_records
from gsvis.package.fidelity import Fidelity
from gsvis.package.manifest import MANIFEST, Manifest
from gsvis.package.unpack import unpack_levels
from gsvis.scene.cameras import Cameras
from gsvis.stream import Quality, StreamedScene
from gsvis.world.manifest import WORLD, WorldManifest
from tests.fuzz.cameras import files_in
from tests.fuzz.containers import rows_of, sealed_manifest
from tests.fuzz.mutators import mutate
from tests.fuzz.targets import Case, Target, change_files
from tests.stream.worlds import package_of
from tests.world.manifests import example

__all__ = ["TARGETS"]

N = 40
OLD = Path(__file__).parents[1] / "package" / "data" / "version2.zip"


def packages() -> list[Case]:
    found = []
    with TemporaryDirectory() as folder:
        for name, stores in (("rgb", True), ("hsl", False)):
            package_of(Path(folder) / name, N, name, stores=stores).close()
            found.append(files_in(Path(folder) / name))
        package_of(Path(folder) / "lattice", 400, "rgb", stores=False, lattice=True).close()  # logarithmic chunks
        found.append(files_in(Path(folder) / "lattice"))
        with zipfile.ZipFile(OLD) as archive:  # a package of version 2, with lists of active terms
            found.append({name: archive.read(name) for name in archive.namelist()})
    return found


def manifests() -> list[Case]:
    """Manifests of all packages, and one that says how near what a client gets comes to the scene."""
    found = [{MANIFEST: case[MANIFEST]} for case in packages()]
    view = {"position": [0, 0, 1.5], "rotation": [1, 0, 0, 0]}
    odd = [7, {}, {**view, "position": [0, 0]}, {**view, "position": "up"}, {**view, "rotation": [True, 0, 0, 0]}]
    odd.append({**view, "position": [10**400, 0, 0]})
    seen = {**json.loads(found[0][MANIFEST]), "provenance": {"views": [view, *odd, view]}}
    found.append({MANIFEST: sealed_manifest(seen)})
    values = {"records": [30.0, 31.0], "cell": [29.0, 30.5], "levels": [40.0, 41.0], "rounding": [60.0, 61.0]}
    near = Fidelity.from_values(values, Cameras.orbit((0, 0, 0), 4.0, 2, width=24, height=20))
    said = {**json.loads(found[0][MANIFEST]), "fidelity": near.as_dict()}
    return [*found, {MANIFEST: sealed_manifest(said)}]


def in_manifest(folder: Path, case: Case) -> None:
    (name,) = case
    found = Manifest.read(folder / name)
    assert found.gaussians == sum(block.count for block in found.blocks)
    found.sizes()
    for view in found.views:
        assert [len(numbers) for numbers in view.values()] == [3, 4]
        assert np.isfinite([*view["position"], *view["rotation"]]).all()
    near = found.info.fidelity
    if near is not None:
        assert len(near.cameras) == near.summary()["views"]
        assert np.isfinite(near.cameras.viewmats).all()


def worlds() -> list[Case]:
    return [{WORLD: example().to_json()}]


def in_world(folder: Path, case: Case) -> None:
    (name,) = case
    found = WorldManifest.read(folder / name)
    with pytest.raises(ValueError, match="node"):
        found.node(len(found))
    tiles = found.tiles_at([[0.5, 0.5, 0.5], [-1e9, 0.0, 1e9]])
    assert len(tiles) == 2
    assert tiles.max() < len(found.tiles)
    for tile in found.tiles:
        for piece in [] if tile.beyond is None else tile.beyond.pieces:
            assert found.node(piece.node).gaussians >= 1
            if piece.count < 1 << 20:
                assert len(piece.ids()) == piece.count
    again = WorldManifest.read(_written(folder / "again.json", found))
    assert again == found


def _written(path: Path, manifest: WorldManifest) -> Path:
    manifest.write(path)
    return path


def in_package(folder: Path, case: Case) -> None:
    with Package.open(folder) as package:
        package.verify()
        contents = package.contents
        with pytest.raises(ValueError, match="table"):
            decode_records(contents.records[:-1], contents.table, contents.layout)
        some = np.arange(0, len(package), 7)
        assert len(contents.gaussians(some)) == len(some)
        part, first = package.part_of(len(package) - 1)
        assert np.array_equal(part.records, contents.records[first : first + len(part.records)])
        with pytest.raises(ValueError, match="gaussian"):
            package.part_of(len(package))
        if package.epsilon is None:
            with pytest.raises(SceneError, match="epsilon"):
                _ = package.active_terms
        if package.manifest.visibility is None:
            with pytest.raises(SceneError, match="prepare it with visibility"):
                _ = package.visibility
        levels = unpack_levels(package, sh_degree=0)
        assert np.isfinite(levels.union.means).all()
        for quality in (None, Quality()):
            scene = StreamedScene.open(package, quality=quality)
            assert len(scene) == len(levels.union)


def change_package(rng: Random, case: Case, target: Target) -> Case:
    """Change the manifest, or a part, which then gets its new name."""
    names = [name for name in sorted(case) if name != MANIFEST and "@" not in name]
    try:
        manifest = json.loads(case[MANIFEST])
        kinds = {row["sha256"]: kind for kind, row in _rows(manifest)}
    except (KeyError, TypeError, ValueError, AttributeError):
        return change_files(rng, case, target)
    if not names or rng.random() < 0.35:
        return {**case, MANIFEST: mutate(rng, "manifest", case[MANIFEST])}
    if rng.random() < 0.05:
        return change_files(rng, case, target)
    name = rng.choice(names)
    digest, _, suffix = name.rpartition("/")[2].partition(".")
    data = mutate(rng, kinds.get(digest, "arrow"), case[name])
    found = {key: value for key, value in case.items() if key != name}
    new = hashlib.sha256(data).hexdigest()
    found[f"parts/{new}.{suffix}"] = data
    for _, row in _rows(manifest):
        if row["sha256"] == digest:
            row["sha256"], row["bytes"] = new, len(data)
            if suffix == "arrow" and "count" in row and rng.random() < 0.5:
                row["count"] = rows_of(data) or row["count"]
    for key in ("visibility", "active_terms"):
        if manifest.get(key):
            manifest[key]["bytes"] = sum(row["bytes"] for row in manifest[key]["parts"])
    found[MANIFEST] = sealed_manifest(manifest)
    return found


def _rows(manifest: dict[str, Any]) -> list[tuple[str, dict[str, Any]]]:
    """All objects of a manifest that name a part, and the kind of it."""
    rows, kind = [("arrow", row) for row in manifest["chunks"]], "arrow" if manifest["version"] == 2 else "coded"
    for block in manifest["blocks"]:
        rows += [(kind, block), *((kind, row) for row in block["term_parts"])]
    for key, of_store in (("visibility", "pvs"), ("active_terms", "active")):
        if manifest.get(key):
            rows += [(of_store, row) for row in manifest[key]["parts"]]
    return rows


P = "gsvis.package."

TARGETS = [
    Target("manifest", manifests, in_manifest, kinds={MANIFEST: "manifest"}, modules=(P + "manifest", P + "fidelity")),
    Target("world", worlds, in_world, kinds={WORLD: "manifest"}, modules=("gsvis.world.manifest",)),
    Target(
        "package",
        packages,
        in_package,
        (FormatError, FileNotFoundError),
        change=change_package,
        modules=(P + "package", P + "parts", P + "contents", P + "codec", P + "manifest", P + "blocks", P + "coded"),
        weight=1.5,
    ),
]
