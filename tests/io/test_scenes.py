"""`load_scene` and `save_scene`: the format is found by content, faults are one clear line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gsvis.errors import FormatError
from gsvis.io import load_scene, save_scene
from gsvis.scene.gaussians import Gaussians
from tests.io.scene_files import (
    compressed_ply_bytes,
    ply_bytes,
    random_scene,
    raw_columns,
    sog_files,
    splat_bytes,
    spz_bytes,
    streamed_files,
    write_files,
    zip_bytes,
)

SCENE = random_scene(40, 0)
BY_CONTENT = {
    "ply": ply_bytes(raw_columns(SCENE)),
    "compressed": compressed_ply_bytes(SCENE),
    "spz3": spz_bytes(SCENE, 3),
    "spz4": spz_bytes(SCENE, 4),
    "sog": zip_bytes(sog_files(SCENE)),
}


@pytest.mark.parametrize("kind", BY_CONTENT)
@pytest.mark.parametrize("name", ["a", "a.bin", "a.ply", "a.splat", "a.SPZ", "a.sog"])
def test_the_content_decides_not_the_name(tmp_path: Path, kind: str, name: str) -> None:
    (tmp_path / name).write_bytes(BY_CONTENT[kind])
    assert len(load_scene(tmp_path / name)) == len(SCENE)
    assert len(load_scene(str(tmp_path / name))) == len(SCENE)


def test_the_suffix_decides_where_there_is_no_magic(tmp_path: Path) -> None:
    (tmp_path / "a.splat").write_bytes(splat_bytes(SCENE))
    assert len(load_scene(tmp_path / "a.splat")) == len(SCENE)


def test_folders_and_their_meta_data(tmp_path: Path) -> None:
    sog = write_files(tmp_path / "sog", sog_files(SCENE))
    streamed = write_files(tmp_path / "streamed", streamed_files({0: SCENE, 1: SCENE[:10]}))
    (streamed / "renamed.json").write_bytes((streamed / "lod-meta.json").read_bytes())
    assert len(load_scene(sog)) == len(load_scene(sog / "meta.json")) == len(SCENE)
    for path in (streamed, streamed / "lod-meta.json", streamed / "renamed.json"):
        assert len(load_scene(path)) == len(SCENE)
        assert len(load_scene(path, lod=1)) == 10


def test_a_level_of_a_file_without_levels_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.ply").write_bytes(BY_CONTENT["ply"])
    with pytest.raises(ValueError, match="lod: expected None"):
        load_scene(tmp_path / "a.ply", lod=0)


def test_nothing_there_is_file_not_found(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="no scene file or folder here") as caught:
        load_scene(tmp_path / "no.ply")
    assert caught.value.filename == str(tmp_path / "no.ply")


@pytest.mark.parametrize("data", [b"", b"hello", b"{}", bytes(100), b"solid cube"])
@pytest.mark.parametrize("name", ["a.xyz", "a.ply", "a.spz", "a.sog", "a.json", "a.splat", "a.ksplat", "a"])
def test_unknown_content_is_refused(tmp_path: Path, name: str, data: bytes) -> None:
    (tmp_path / name).write_bytes(data)
    with pytest.raises(FormatError) as caught:
        load_scene(tmp_path / name)
    assert "\n" not in str(caught.value)


def test_the_known_kinds_are_listed(tmp_path: Path) -> None:
    (tmp_path / "a.xyz").write_bytes(b"1 2 3")
    for path in (tmp_path / "a.xyz", tmp_path):
        with pytest.raises(FormatError, match=r"PLY.*splat.*SPZ.*SOG.*lod-meta\.json"):
            load_scene(path)


@pytest.mark.parametrize("suffix", [".ply", ".spz", ".sog", ".PLY"])
def test_written_scenes_read_back(tmp_path: Path, suffix: str) -> None:
    scene = random_scene(60, 2)
    path = tmp_path / "new" / f"a{suffix}"
    save_scene(scene, path)
    got = load_scene(path)
    assert got.sh_degree == 2
    np.testing.assert_allclose(got.means, scene.means, atol=3e-4)
    np.testing.assert_allclose(got.covars(), scene.covars(), atol=0.05)
    assert [p.name for p in path.parent.iterdir()] == [path.name]


@pytest.mark.parametrize("name", ["a.xyz", "a", "a.splat"])
def test_formats_that_are_only_read(tmp_path: Path, name: str) -> None:
    with pytest.raises(ValueError, match=r"path: expected a name that ends in \.ply, \.spz, \.sog"):
        save_scene(SCENE, tmp_path / name)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("suffix", [".ply", ".spz", ".sog", ".ksplat", ".compressed.ply"])
def test_an_empty_scene_is_not_written(tmp_path: Path, suffix: str) -> None:
    with pytest.raises(ValueError, match="at least one"):
        save_scene(Gaussians.empty(), tmp_path / f"a{suffix}")
    assert list(tmp_path.iterdir()) == []
