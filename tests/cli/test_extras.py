"""Every command without the optional packages: it works, or names in one line the extra that brings the package.

All of them are missing at once where commands have to work. One alone is missing only where it has to be named: a
command that works without any package needs none of them.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest
from packaging.requirements import Requirement

from gsvis._extras import EXTRAS, has, project_of, remedy_of, require
from gsvis.errors import MissingExtraError
from gsvis.io import save_scene
from gsvis.io.poses import write_poses
from gsvis.package import in_package_order, write_package
from gsvis.pvs.build import build_pvs
from gsvis.pvs.cells import CellGrid
from gsvis.pvs.config import PvsConfig
from gsvis.scene.levels import Levels
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.procedural import two_rooms
from tests import warm_start
from tests.cli.test_docs import commands
from tests.package.worlds import colors_of
from tests.simulate.streets import walk
from tests.train.photo_files import cloud, write_photos

ROOT = Path(__file__).parents[2]
BLOCKED = {
    "torch": ("torch",),
    "matplotlib": ("matplotlib",),
    "dask and pycolmap": ("dask", "distributed", "pycolmap"),
    "all of them": tuple(EXTRAS),
}
BOX = ["--box", "1", "1", "1", "7", "3", "2"]
TINY = ["--cells", "2", "--face-size", "16", "--limit", "0.05", "--max-inner", "1", "--workers", "1"]
TINY += ["--max-terms", "0", *BOX]
SMALL = ["--width", "24", "--height", "20"]
CLUSTER = "tcp://127.0.0.1:1"  # nobody answers there
COMMANDS = {
    "inspect": ["inspect", "IN/rooms.ply"],
    "analyze": ["analyze", "IN/rooms.ply", "-o", "OUT/analysis", "--views", "1", *SMALL, "--traced-sample", "0"],
    "render": ["render", "IN/rooms.ply", "-o", "OUT/view.png", *SMALL],
    "render --depth": ["render", "IN/rooms.ply", "-o", "OUT/depth.png", *SMALL, "--depth"],
    "render --contributors": ["render", "IN/rooms.ply", "--contributors", "3,3", *SMALL],
    "pvs": ["pvs", "IN/rooms.ply", "-o", "OUT/a.pvs", "--dry-run", "--cells", "2", "--face-size", "16", "--workers",
            "1", "--certify", "256", "--max-inner", "1"],
    "pvs --scheduler": ["pvs", "IN/rooms.ply", "-o", "OUT/b.pvs", "--cells", "2", "--scheduler", "CLUSTER"],
    "pvs-report": ["pvs-report", "IN/rooms.pvs", "IN/rooms.ply", "-o", "OUT/sets", "--cells", "1", "--eyes", "1"],
    "color": ["color", "IN/rooms.ply", "-o", "OUT/c.arrow", "--views", "2", "--held-out", "0", "--max-terms", "0"],
    "color --report": ["color", "IN/rooms.ply", "-o", "OUT/d.arrow", "--report", "OUT/colors"],
    "train": ["train", "IN/photos", "-o", "OUT/t.ply", "--steps", "2", "--sh-degree", "0"],
    "levels": ["levels", "IN/rooms.ply", "-o", "OUT/levels"],
    "convert": ["convert", "IN/rooms.ply", "OUT/a.spz"],
    "convert to a page": ["convert", "IN/rooms.ply", "IN/rooms.ply", "-o", "OUT/a.html"],
    "clean": ["clean", "IN/rooms.ply", "-o", "OUT/clean.ply", "--report", "OUT/clean", "--eyes", "1", "--held-out", "1",
              *BOX],
    "space": ["space", "IN/rooms.ply", "-o", "OUT/space.glb", *BOX],
    "cut": ["cut", "IN/rooms.ply", "-o", "OUT/cut.ply", "--face-size", "16", "--held-out", "1", "--min-psnr", "0",
            *BOX],
    "paint": ["paint", "IN/rooms.ply", "-o", "OUT/painted.ply", "--face-size", "16", "--eyes", "2", *BOX],
    "prepare": ["prepare", "IN/rooms.ply", "-o", "OUT/a.gsvis", *TINY],
    "prepare --levels none": ["prepare", "IN/rooms.ply", "-o", "OUT/b.gsvis", *TINY, "--levels", "none"],
    "prepare --dry-run": ["prepare", "IN/rooms.ply", "-o", "OUT/c.gsvis", *TINY, "--levels", "none", "--dry-run"],
    "world": ["world", "IN/rooms.ply", "-o", "OUT/a.gsworld"],
    "world --levels none": ["world", "IN/rooms.ply", "-o", "OUT/b.gsworld", "--levels", "none", "--cells", "1",
                            "--face-size", "16", "--limit", "0.05", "--workers", "1", "--tile", "5000"],
    "world --dry-run": ["world", "IN/rooms.ply", "-o", "OUT/c.gsworld", "--levels", "none", "--dry-run", "--cells", "1",
                        "--face-size", "16", "--limit", "0.05", "--workers", "1"],
    "verify": ["verify", "IN/rooms.gsvis"],
    "unpack": ["unpack", "IN/rooms.gsvis", "-o", "OUT/unpacked"],
    "export": ["export", "IN/rooms.gsvis", "-o", "OUT/site"],
    "serve": ["serve", "IN/rooms.gsvis", "--port", "0"],
    "view": ["view", "IN/rooms.ply", "--port", "0", "--no-browser"],
    "simulate": ["simulate", "IN/rooms.gsvis", "--path", "IN/walk.csv", "-o", "OUT/sim", "--seconds", "1", "--every",
                 "0.5", *SMALL, "--mbit", "0.2"],
}  # fmt: skip
NEEDS = {
    "analyze": "matplotlib",
    "color --report": "matplotlib",
    "levels": "torch",
    "prepare": "torch",
    "pvs --scheduler": "dask",
    "pvs-report": "matplotlib",
    "render --depth": "matplotlib",
    "space": "skimage",
    "train": "torch",
    "world": "torch",
}
SLOW = {"color --report", "levels", "pvs-report", "prepare", "train", "world"}
"""Run only where they have to be refused: their own tests run them with everything installed."""


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A scene, its visible sets, its package, photographs and a walk."""
    folder = tmp_path_factory.mktemp("in")
    rooms = in_package_order(Levels.single(two_rooms(1000, sh_degree=1).gaussians))
    save_scene(rooms.union, folder / "rooms.ply")
    write_package(folder / "rooms.gsvis", rooms, colors_of(len(rooms.union))[1]).close()
    space = NavigableSpace.from_box((1, 1, 1), (7, 3, 2), 12)
    config = PvsConfig(method="raster", size=16, rays=256, max_inner=0)
    build_pvs(rooms.union, CellGrid.over(space, max_cells=2), space, folder / "rooms.pvs", config).close()
    write_poses(walk(3.0), folder / "walk.csv")
    write_photos(folder / "photos", points=cloud())
    return folder


def needed(command: str, blocked: tuple[str, ...]) -> str | None:
    package = NEEDS.get(command)
    return package if package in blocked else None


@pytest.mark.parametrize("blocked", BLOCKED.values(), ids=BLOCKED)
def test_each_command_works_or_names_the_extra(blocked: tuple[str, ...], inputs: Path, tmp_path: Path) -> None:
    names = [name for name in COMMANDS if needed(name, blocked)]
    if blocked == BLOCKED["all of them"]:
        names += [name for name in COMMANDS if name not in names and name not in SLOW]
    places = {"IN": str(inputs), "OUT": str(tmp_path), "CLUSTER": CLUSTER}
    words = [[re.sub(r"^(IN|OUT|CLUSTER)\b", lambda m: places[m[0]], w) for w in COMMANDS[name]] for name in names]
    start = subprocess.Popen if blocked == BLOCKED["all of them"] else warm_start.Popen
    command = [sys.executable, "-m", "tests.cli.blocked", *blocked]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with start(command, cwd=ROOT, text=True, **pipes) as ran:
        out, err = ran.communicate(json.dumps(words))
    assert ran.returncode == 0, err
    for name, (code, err) in zip(names, json.loads(out), strict=True):
        package = needed(name, blocked)
        if package is None:
            assert code == 0, (name, err)
        else:
            assert code == 2, (name, err)
            assert len(err.splitlines()) == 1, (name, err)
            line = err.strip()
            assert line.startswith("gsvis: error: "), name
            assert line.endswith(f"expected the package {project_of(package)}, got none; {remedy_of(package)}"), name
    made = {path.name for path in tmp_path.iterdir()}
    assert "t.ply" not in made
    if blocked == BLOCKED["all of them"]:
        assert {"a.spz", "b.gsvis", "c.arrow", "sim", "site", "unpacked", "view.png"} <= made
        page = (tmp_path / "sim" / "report.html").read_text(encoding="utf-8")
        assert page.count("Not drawn: ") == 7
        assert not (tmp_path / "sim" / "qoe.png").exists()


def test_every_command_is_tried() -> None:
    assert set(commands()) == {"gsvis", *(f"gsvis {name.replace(',', '').split()[0]}" for name in COMMANDS)}
    assert set(NEEDS) <= set(COMMANDS)
    assert set(NEEDS.values()) <= {package for blocked in BLOCKED.values() for package in blocked}


def test_extras_are_those_of_the_project() -> None:
    text = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    (table,) = re.findall(r"^\[project\.optional-dependencies\]\n(.*?)^\[", text, flags=re.DOTALL | re.MULTILINE)
    groups = dict(re.findall(r"^(\w+) = \[(.*?)\]$", table, flags=re.DOTALL | re.MULTILINE))
    lines = {extra: [Requirement(line) for line in re.findall(r'"(.*?)"', block)] for extra, block in groups.items()}
    for package, extra in EXTRAS.items():
        names = {line.name.removesuffix("-cpu") for line in lines[extra]}
        assert project_of(package) in names | {each for line in lines[extra] for each in line.extras}, package
    (joined,) = lines["all"]
    assert joined.extras == {"cluster", "mesh", "open3d", "report", "torch", "train"}


def test_a_missing_package_is_named_with_its_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    require("this test", "matplotlib")
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    assert not has("matplotlib")
    with pytest.raises(MissingExtraError) as caught:
        require("this test", "matplotlib")
    assert str(caught.value) == 'this test: expected the package matplotlib, got none; pip install "gsvis[report]"'
    assert isinstance(caught.value, ImportError)
