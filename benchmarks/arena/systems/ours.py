"""gsvis: the scene is trained for half of the budget, then `gsvis prepare --photos` makes a package of it.

Three ways: by default, with records rounded as images allow (`--record-psnr`), and with every piece as the paper has it
(`--as-in-paper`). All are streamed by our scheduler, simulated message by message. Sets and colors are made in the
seconds that `prepare` takes; what it takes beyond the other half of the budget is in the table.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

from arena.budget import Allowance
from arena.course import Course
from arena.streams import Streamed
from arena.systems.gaussians import HALF, SCENE
from arena.systems.system import System, Training
from gsvis.abr import AbrConfig
from gsvis.errors import SceneError
from gsvis.io import load_scene
from gsvis.package import Package
from gsvis.progress import Progress
from gsvis.simulate import Adaptive, Stage
from gsvis.stream import StreamedScene

__all__ = ["PACKAGE", "SYSTEMS", "open_package"]

PACKAGE = "scene.gsvis"
WORK = f"{PACKAGE}.work"

_COARSE = ("--cells", "16", "--face-size", "256", "--workers", "1")
"""Sets of few cells from small images: those of the defaults take many times the budget of the arena."""

_ROUNDED = ("--record-psnr", "48")
"""Rounded records as `docs/design/122` has them; chosen on nika."""


def _prepare(*words: str, begun: str | None = None) -> Callable[[Course, Allowance, Path, Progress], None]:
    """Return a training that prepares a package with these options.

    Args:
        words: Options of `gsvis prepare`.
        begun: Name of a training whose kept work is used again; None for none.
    """

    def run(course: Course, allowance: Allowance, folder: Path, progress: Progress) -> None:
        progress("prepare", 0, 1)
        width, height = (str(side) for side in course.size)
        scene = folder.parent / HALF.name / SCENE
        command = [sys.executable, "-m", "gsvis", "prepare", str(scene), "-o", str(folder / PACKAGE)]
        command += ["--photos", str(course.folder), "--width", width, "--height", height, *_COARSE, *words]
        if allowance.steps is not None:
            command += ["--steps", str(allowance.steps), "--cells", "4", "--face-size", "64"]
        if begun is not None:
            shutil.copytree(folder.parent / begun / WORK, folder / WORK)
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode != 0:
            last = (done.stderr.strip().splitlines() or ["no message"])[-1]
            raise SceneError(f"gsvis prepare ended with {done.returncode}: {last}")
        progress("prepare", 1, 1)

    return run


def open_package(folder: Path) -> tuple[Package, StreamedScene]:
    """Return the package of a training, open, and its scene.

    Raises:
        SceneError: If it is a package of another scene than the one trained here.
    """
    package = Package.open(folder / PACKAGE)
    streamed = StreamedScene.open(package)
    names = streamed.contents.names
    count = int((streamed.contents.last == len(names) - 1).sum())
    scene = folder.parent / HALF.name / SCENE
    expected = len(load_scene(scene))
    if count != expected:
        package.close()
        raise SceneError(
            f"{folder / PACKAGE}: expected a package of {scene.name} with {expected:,} Gaussians, got one with"
            f" {count:,}; it is of another scene or level: delete its folder"
        )
    return package, streamed


def _open(policy: str, terms: str) -> Callable[[Course, Path], Streamed]:
    """Return an opener of a package that is sent in one way."""

    def open_here(course: Course, folder: Path) -> Streamed:
        package, streamed = open_package(folder)
        sent = streamed.sending(terms)
        config = AbrConfig(policy=policy)
        stage = Stage(sent.contents)
        count = int(stage.highest.sum())
        nbytes = sum(part.nbytes for part in package.manifest.parts())
        return Streamed(stage, lambda: Adaptive(sent, course.field_of_view, config), nbytes, count)

    return open_here


OURS = Training("gsvis", _prepare(), HALF)
ROUNDED = Training("rounded", _prepare(*_ROUNDED, begun=OURS.name), OURS)
PAPER = Training("paper", _prepare("--as-in-paper"), HALF)

SYSTEMS = (
    System("gsvis", OURS, _open("utility", "pose"), "this repository"),
    System("gsvis, 48 dB records", ROUNDED, _open("utility", "pose"), "this repository, by `--record-psnr 48`"),
    System(
        "gsvis, as in the paper",
        PAPER,
        _open("fov-first", "cell"),
        "SRBF-Gaussian, by `--as-in-paper`",
        "levels are trained for few steps; terms are sent by cell, the field of view first",
        "PSNR against the full scene alone",
    ),
)
