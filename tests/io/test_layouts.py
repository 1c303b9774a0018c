"""Scenes in the folders of tools that store content apart and link to it: Hugging Face's cache, git-annex, DVC."""

from __future__ import annotations

import hashlib
import os
from pathlib import Path

import numpy as np
import pytest

from gsvis.errors import FormatError
from gsvis.files.limits import inside
from gsvis.io.levels import load_levels, save_levels
from gsvis.io.scenes import load_scene
from tests.io.scene_files import random_scene, sog_files, streamed_files, write_files, zip_bytes
from tests.package.worlds import levels_of

WAY_OUT = r"copy the files, e\.g\. with cp -rL, or download to a plain folder"


def linked_to(store: Path, folder: Path, *, absolute: bool = False) -> Path:
    """The folder, its files moved to a store by their digest and replaced by links."""
    store.mkdir(parents=True, exist_ok=True)
    for path in sorted(folder.rglob("*")):
        if path.is_file():
            content = store / hashlib.sha256(path.read_bytes()).hexdigest()
            path.rename(content)
            path.symlink_to(content if absolute else os.path.relpath(content, path.parent))
    return folder


def in_hub(root: Path, files: dict[str, bytes], below: str = "scene") -> Path:
    """The folder of a scene in a repository of Hugging Face's cache."""
    cache = root / "models--somebody--scenes"
    return linked_to(cache / "blobs", write_files(cache / "snapshots" / ("a" * 40) / below, files))


SCENE = random_scene(50, 0)
STREAMED = streamed_files({0: SCENE, 1: random_scene(20, 0)})


@pytest.mark.parametrize("below", ["scene", ".", "scenes/room"])
def test_a_sog_in_a_cache_of_the_hub_loads(tmp_path: Path, below: str) -> None:
    folder = in_hub(tmp_path, sog_files(SCENE) | {"a.sog": zip_bytes(sog_files(SCENE))}, below)
    (tmp_path / "by another name").symlink_to(folder)
    for path in (folder, folder / "meta.json", folder / "a.sog", tmp_path / "by another name"):
        assert len(load_scene(path)) == len(SCENE)


def test_a_streamed_sog_in_a_cache_of_the_hub_loads(tmp_path: Path) -> None:
    folder = in_hub(tmp_path, STREAMED)
    assert len(load_scene(folder, lod=0)) == len(SCENE)
    assert len(load_scene(folder, lod=1)) == 20


@pytest.mark.parametrize(
    "target",
    [
        "../../../secret",  # beside the blobs
        "../../../../models--other--one/blobs/secret",  # of another repository
        "../../../blobs/out",  # by way of a link in the blobs
        "../../../blobs/../secret",
        "../../other/secret",  # another revision, whose own links are not looked at
    ],
)
def test_links_to_elsewhere_in_a_cache_are_refused(tmp_path: Path, target: str) -> None:
    folder = in_hub(tmp_path, sog_files(SCENE))
    for place in (
        "models--somebody--scenes",
        "models--other--one/blobs",
        "models--somebody--scenes/snapshots/other",
    ):
        write_files(tmp_path / place, {"secret": b"hunter2"})
    (tmp_path / "models--somebody--scenes" / "blobs" / "out").symlink_to(tmp_path / "models--other--one/blobs/secret")
    plane = folder / "quats.webp"
    plane.unlink()
    plane.symlink_to(target)
    assert plane.read_bytes() == b"hunter2"
    with pytest.raises(FormatError, match=f"a link that leads out of it; {WAY_OUT}"):
        load_scene(folder)


def test_a_folder_of_that_name_alone_is_no_cache(tmp_path: Path) -> None:
    write_files(tmp_path / "blobs", {"a": b"1"})
    folder = write_files(tmp_path / "snapshots", {"b": b"2"})
    (folder / "a").symlink_to("../blobs/a")
    with pytest.raises(FormatError, match="a link that leads out of it"):
        inside(folder, "", folder, "a")  # no revision between


LAYOUTS = {
    "git-annex": (".git/annex/objects/x1/y2", False),
    "DVC": (".dvc/cache/files/sha256", True),
    "a hub's cache": ("models--somebody--scenes/blobs", False),
}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_levels_load_from_every_layout_and_their_content_is_checked(tmp_path: Path, layout: str) -> None:
    store, absolute = LAYOUTS[layout]
    root = tmp_path / Path(store).parts[0] / "snapshots" / "a" if "blobs" in store else tmp_path
    levels = levels_of(20)
    save_levels(levels, root / "levels", {"up": [0, 0, 1]})
    folder = linked_to(tmp_path / store, root / "levels", absolute=absolute)
    assert np.array_equal(load_levels(folder).union.means, levels.union.means)
    other = write_files(tmp_path / "elsewhere", {"other.ply": b"hunter2"}) / "other.ply"
    victim = next(iter(sorted(folder.glob("*.ply"))))
    victim.unlink()
    victim.symlink_to(other)
    with pytest.raises(FormatError, match="SHA-256") as caught:
        load_levels(folder)
    assert "hunter2" not in str(caught.value)


@pytest.mark.parametrize("layout", ["git-annex", "DVC"])
def test_a_sog_of_another_layout_names_the_way_out(tmp_path: Path, layout: str) -> None:
    store, absolute = LAYOUTS[layout]
    for name, files in (("sog", sog_files(SCENE)), ("streamed", STREAMED)):
        folder = linked_to(tmp_path / store, write_files(tmp_path / name, files), absolute=absolute)
        with pytest.raises(FormatError, match=WAY_OUT):
            load_scene(folder)
