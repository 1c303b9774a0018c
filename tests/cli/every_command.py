"""Every command that writes, at its smallest, and what they read: for tests of what holds of all of them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest

from gsvis.cli import main
from gsvis.export.page import write_html, write_site
from gsvis.io import save_scene
from gsvis.io.poses import write_poses
from gsvis.package import in_package_order, write_package
from gsvis.scene.levels import Levels
from gsvis.scene.procedural import two_rooms
from tests.export.viewers import viewer_of
from tests.few_views import take_few_views
from tests.known_spaces import coarse_spaces
from tests.package.worlds import colors_of
from tests.simulate.streets import walk
from tests.train.photo_files import cloud, write_photos

BOX = "--box 0.5 0.5 0.5 3.5 3.5 2.5"
LOOK = "--views 3 --width 12 --height 9 --traced-sample 20 --rays-per-face 1"
COMMANDS = {
    "convert": "convert {ply} {out}/a.sog --overwrite",
    "convert ply": "convert {ply} {out}/a.ply --overwrite",
    "convert ksplat": "convert {ply} {out}/a.ksplat --overwrite",
    "convert spz": "convert {ply} {out}/a.spz --overwrite",
    "render png": "render {ply} -o {out}/a.png --width 64 --height 48 --depth --eye 1 1 1",
    "render gif": "render {ply} -o {out}/a.gif --width 64 --height 48 --orbit 2",
    "render folder": "render {ply} -o {out}/ --width 64 --height 48 --orbit 2",
    "analyze": f"analyze {{ply}} -o {{out}} {LOOK}",
    "pvs": f"pvs {{ply}} -o {{out}}/a.pvs --cells 4 --face-size 16 --workers 1 --certify 256 --max-inner 1 {BOX}",
    "pvs-report": "pvs-report {pvs} {ply} -o {out} --cells 2 --eyes 1 --dense 1 --width 24 --height 18",
    "color": "color {ply} -o {out}/a.arrow --views 2 --held-out 0 --width 24 --height 18 --max-terms 1 --color-steps 0",
    "train": "train {photos} -o {out}/a.ply --steps 4 --evaluate-every 4 --sh-degree 0 --overwrite",
    "levels": "levels {ply} -o {out} --steps 2 --width 24 --height 20 --views 2 --held-out 1",
    "prepare": "prepare {ply} -o {out}/a.gsvis --levels none --cells 2 --face-size 16 --limit 0.05 --max-inner 1"
    " --workers 1 --max-terms 0",
    "world": "world {ply} -o {out}/a.gsworld --levels none --cells 1 --face-size 16 --limit 0.05 --workers 1"
    " --tile 5000",
    "unpack": "unpack {package} -o {out}",
    "clean": f"clean {{ply}} -o {{out}}/a.ply --select {{out}}/a.npy --eyes 1 --held-out 0 --overwrite {BOX}",
    "cut": f"cut {{ply}} -o {{out}}/a.ply --select {{out}}/a.npy --face-size 16 --held-out 0 --limit 0.1 --overwrite"
    f" {BOX}",
    "paint": f"paint {{ply}} -o {{out}}/a.ply --values {{out}}/a.npy --face-size 16 --eyes 1 --overwrite {BOX}",
    "space": "space {ply} -o {out}/a.voxel.json --overwrite",
    "export": "export {package} -o {out}/site",
    "simulate": "simulate {package} --path {walk} -o {out} --no-retarget --seconds 1 --every 0.5 --width 32 --height 24"
    " --whole-file {ply}",
}


def words_of(command: str, **places: Path) -> list[str]:
    """The words of a command of the table; names of places may hold spaces."""
    return [word.format(**places) for word in command.split()]


def make_world(folder: Path, photos: Path, name: str = "rooms") -> dict[str, Path]:
    """Write what the commands read."""
    files = {key: folder / f"{name}{suffix}" for key, suffix in _SUFFIXES.items()}
    save_scene(two_rooms(1000, sh_degree=1).gaussians, files["ply"])
    command = "pvs {ply} -o {pvs} --cells 4 --face-size 16 --workers 1 --certify 256 --max-inner 1"
    assert main(words_of(f"{command} {BOX}", **files)) == 0
    levels = in_package_order(Levels.single(two_rooms(1000).gaussians))
    write_package(files["package"], levels, colors_of(len(levels.union))[1]).close()
    write_poses(walk(3.0), files["walk"])
    return {**files, "photos": write_photos(photos, points=cloud())}


_SUFFIXES = {"ply": ".ply", "pvs": ".pvs", "package": ".gsvis", "walk": ".csv"}


@contextmanager
def at_their_smallest(folder: Path) -> Iterator[None]:
    """Find spaces among few voxels and look at packages once; put a stand-in for the viewer into sites.

    Args:
        folder: Where the stand-in is written.
    """
    viewer = viewer_of(folder / "built")
    with ExitStack() as stack:
        patch = stack.enter_context(pytest.MonkeyPatch.context())
        stack.enter_context(take_few_views())
        stack.enter_context(coarse_spaces())
        patch.setattr("gsvis.cli.analyze.PICTURE", 24)
        for write in (write_site, write_html):
            patch.setitem(write.__kwdefaults__, "viewer", viewer)
        yield
