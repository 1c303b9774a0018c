"""Scenes in batches: joined, they are what `load_scene` reads, whatever the format."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from gsvis.errors import FormatError
from gsvis.io import batches, load_scene
from gsvis.io.batches import list_batches, read_batch
from gsvis.io.ply import save_ply
from gsvis.scene.content import scene_hash
from gsvis.scene.gaussians import Gaussians
from tests.io.scene_files import (
    compressed_ply_bytes,
    ply_bytes,
    random_scene,
    raw_columns,
    sog_files,
    splat_bytes,
    streamed_files,
    write_files,
)


def joined(path: Path, lod: int | None = None) -> str:
    return scene_hash(Gaussians.concatenate([read_batch(batch) for batch in list_batches(path, lod)]))


@pytest.mark.parametrize("lod", [None, 0, 1])
def test_a_streamed_scene_is_read_file_by_file(tmp_path: Path, lod: int | None) -> None:
    levels = {0: random_scene(300, 0, seed=1), 1: random_scene(80, 0, seed=2)}
    write_files(tmp_path, streamed_files(levels))
    assert joined(tmp_path, lod) == scene_hash(load_scene(tmp_path, lod))
    found = list_batches(tmp_path, lod)
    assert {batch.kind for batch in found} == {"file"}
    assert sum(batch.count for batch in found) == len(load_scene(tmp_path, lod))
    with pytest.raises(FormatError, match="LOD 7"):
        list_batches(tmp_path, 7)


def test_a_ply_is_read_by_rows_and_other_formats_as_a_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(batches, "ROWS", 16)
    scene = random_scene(70)
    for name, data, kind in (
        ("a.ply", ply_bytes(raw_columns(scene)), "rows"),
        ("b.compressed.ply", compressed_ply_bytes(scene), "whole"),
        ("c.splat", splat_bytes(scene), "whole"),
    ):
        (tmp_path / name).write_bytes(data)
        assert joined(tmp_path / name) == scene_hash(load_scene(tmp_path / name)), name
        assert {batch.kind for batch in list_batches(tmp_path / name)} == {kind}, name


def stamp(path: Path) -> str:
    (batch,) = list_batches(path, stamped=True)
    return batch.stamp


def change(file: Path) -> None:
    """Change the last byte of a file, or turn the order of a document; its times stay, and the size of other files."""
    data, state = bytearray(file.read_bytes()), file.stat()
    if file.suffix == ".json":
        data = bytearray(json.dumps(dict(reversed(json.loads(data).items()))).encode())
    else:
        data[-1] ^= 1
    file.write_bytes(data)
    os.utime(file, ns=(state.st_atime_ns, state.st_mtime_ns))


def test_a_batch_of_a_file_that_changed_is_another_one_or_is_refused(tmp_path: Path) -> None:
    save_ply(random_scene(70), tmp_path / "a.ply")
    (before,), first = list_batches(tmp_path / "a.ply"), stamp(tmp_path / "a.ply")
    assert before.stamp == ""
    os.utime(tmp_path / "a.ply", ns=(1, 1))
    assert stamp(tmp_path / "a.ply") == first
    change(tmp_path / "a.ply")
    assert stamp(tmp_path / "a.ply") != first
    save_ply(random_scene(40), tmp_path / "a.ply")
    assert stamp(tmp_path / "a.ply") != first
    with pytest.raises(FormatError, match="did the file change"):
        read_batch(before)


def test_the_images_beside_a_meta_json_count_with_it(tmp_path: Path) -> None:
    """Their bytes say what the scene needs, and one that changes makes another batch."""
    write_files(tmp_path, sog_files(random_scene(70)))
    (folder,), (file,), before = list_batches(tmp_path), list_batches(tmp_path / "meta.json"), stamp(tmp_path)
    assert file.nbytes == folder.nbytes == sum(path.stat().st_size for path in tmp_path.iterdir())
    image = next(path for path in tmp_path.iterdir() if path.suffix != ".json")
    change(image)
    assert stamp(tmp_path / "meta.json") != before


@pytest.mark.skipif(os.name != "posix", reason="links need rights elsewhere")
@pytest.mark.parametrize("name", [".", "meta.json"])
def test_a_link_that_leads_nowhere_beside_a_scene_does_not_matter(tmp_path: Path, name: str) -> None:
    write_files(tmp_path, sog_files(random_scene(70)))
    before = stamp(tmp_path / name)
    (tmp_path / "notes").symlink_to("gone")
    assert stamp(tmp_path / name) == before


@pytest.mark.parametrize("name", [".", "lod-meta.json"])
def test_a_tree_that_changes_makes_other_batches(tmp_path: Path, name: str) -> None:
    write_files(tmp_path, streamed_files({0: random_scene(300, 0)}))
    before = stamp(tmp_path / name)
    change(tmp_path / "lod-meta.json")
    assert stamp(tmp_path / name) != before


def test_a_truncated_ply_is_refused_before_it_is_read(tmp_path: Path) -> None:
    save_ply(random_scene(70), tmp_path / "a.ply")
    (tmp_path / "a.ply").write_bytes((tmp_path / "a.ply").read_bytes()[:-8])
    with pytest.raises(FormatError, match="truncated"):
        list_batches(tmp_path / "a.ply")
