"""Does every command say the same of a scene that is turned, scaled or shifted?

A scene is written as it is and moved, each as a PLY, and the commands run on each file with small settings. Every
number of their JSON that does not depend on the frame is compared; lengths and volumes are divided by the scale first.

Given: a built-in scene of a few thousand Gaussians, with what `gsvis convert` states of it and without, or scene files.
Measured: the largest relative difference of a number of each command from that of the scene as it is, and which number
it is. Scales are 1e-3 and 1e3, turns (45, 0, 20) and (0, 0, 25) degrees, the shift is a million units in coordinates
of double precision.
Defaults chosen on: nothing; the settings of the commands are small so that a run ends.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from _harness import add_arguments, write_result
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from gsvis.cli import main as gsvis
from gsvis.io import load_scene, save_scene
from gsvis.io.sources import load_source
from gsvis.scene.facts import SceneFacts
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.procedural import BUILTIN_SCENES

TARGET = 0.01
COMMANDS: dict[str, tuple[str, ...]] = {
    "inspect": (),
    "space": ("-o", "OUT/space.voxel.json"),
    "analyze": ("-o", "OUT/analysis", "--views", "8", "--width", "64", "--height", "48", "--traced-sample", "50"),
    "pvs": (
        *("-o", "OUT/sets.pvs", "--cells", "8", "--face-size", "32", "--certify", "512", "--limit", "0.02"),
        *("--max-inner", "2", "--workers", "1"),
    ),
    "levels": (
        *("-o", "OUT/levels", "--steps", "4", "--views", "4", "--held-out", "4", "--width", "48", "--height", "36"),
    ),
    "color": ("-o", "OUT/color.arrow", "--views", "4", "--held-out", "4", "--width", "48", "--height", "36"),
    "prepare": (
        *("-o", "OUT/scene.gsvis", "--cells", "8", "--steps", "4", "--views", "4", "--width", "48", "--height", "36"),
        *("--face-size", "32", "--limit", "0.02", "--max-inner", "2", "--workers", "1"),
    ),
    "clean": ("--report", "OUT/clean", "--eyes", "8", "--held-out", "4"),
}
LENGTHS = {"voxel", "voxel_size", "cell_size", "scales", "near", "far", "widest", "radius"}
VOLUMES = {"volume", "navigable_volume"}
# Of the machine or the settings, in the frame of the scene, or bytes of a file whose numbers have other digits.
LEFT_OUT = {
    *(
        "seconds",
        "created",
        "file_bytes",
        "version",
        "peak_bytes",
        "bytes",
        "nbytes",
        "threads",
        "workers",
        "load",
        "memory",
    ),
    *("box", "bounds", "robust_bounds", "origin", "up", "up_vector", "low", "high", "eye", "target", "cameras"),
    *("shape", "center", "position", "rotation", "facts", "bytes_in_memory", "files", "parameters", "config"),
}


@dataclass(frozen=True)
class Move:
    """What is done to a scene: `scale * turn @ x + shift`."""

    name: str
    scale: float = 1.0
    degrees: tuple[float, float, float] = (0.0, 0.0, 0.0)
    shift: float = 0.0

    @property
    def turn(self) -> NDArray[np.float64]:
        return np.asarray(Rotation.from_euler("xyz", self.degrees, degrees=True).as_matrix())

    def __call__(self, g: Gaussians) -> Gaussians:
        """Return the moved scene; a shift is in its origin, which a PLY writes as doubles."""
        moved = g.transform(self.turn, scale=self.scale)
        origin = np.asarray(moved.facts.origin) + self.shift
        return moved.with_facts(replace(moved.facts, origin=(float(origin[0]), float(origin[1]), float(origin[2]))))


MOVES = (
    Move("scaled by 0.001", scale=1e-3),
    Move("scaled by 1000", scale=1e3),
    Move("turned by (45, 0, 20)", degrees=(45.0, 0.0, 20.0)),
    Move("turned by 25", degrees=(0.0, 0.0, 25.0)),
    Move("shifted by 1e6", shift=1e6),
)


def numbers(value: Any, path: str = "", power: int = 0) -> Iterator[tuple[str, float, int]]:
    """Yield the numbers of a JSON document that do not depend on the frame, and their power of length."""
    if isinstance(value, dict):
        for key, each in value.items():
            if key not in LEFT_OUT and not key.endswith("_s"):
                more = 1 if key in LENGTHS else 3 if key in VOLUMES else power
                yield from numbers(each, f"{path}.{key}".lstrip("."), more)
    elif isinstance(value, list):
        for k, each in enumerate(value):
            yield from numbers(each, f"{path}[{k}]", power)
    elif isinstance(value, int | float) and not isinstance(value, bool):
        yield path, float(value), power


def compare(first: dict[str, Any], second: dict[str, Any], scale: float = 1.0) -> tuple[float, str, int]:
    """Return the largest relative difference between two documents, where it is, and how many numbers were compared.

    Args:
        first: Of the scene as it is.
        second: Of the moved scene.
        scale: Its units per unit.
    """
    known = {path: value for path, value, _ in numbers(first)}
    found = {path: value / scale**power for path, value, power in numbers(second)}
    worst, where = 0.0, ""
    for path in known.keys() | found.keys():
        if path not in known or path not in found:
            return 1.0, f"{path}: only once", len(known)
        size = max(abs(known[path]), abs(found[path]))
        apart = abs(known[path] - found[path]) / size if size > 1e-9 else 0.0
        if apart > worst:
            worst, where = apart, f"{path}: {known[path]:.6g}, {found[path]:.6g}"
    return worst, where, len(known)


def run(command: str, scene: Path, folder: Path) -> dict[str, Any]:
    """Return the JSON document of a command.

    Raises:
        RuntimeError: If it fails.
    """
    words = [word.replace("OUT", str(folder)) for word in COMMANDS[command]]
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = gsvis([command, str(scene), *words, "--json"])
    if code:
        raise RuntimeError(f"{command} {scene.name}: {err.getvalue()[-300:]}")
    found: dict[str, Any] = json.loads(out.getvalue())
    return found


def documents(g: Gaussians, commands: tuple[str, ...]) -> dict[str, Any]:
    """Return the documents of commands on a scene; a text where one fails."""
    found: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        save_scene(g, folder / "scene.ply")
        for command in commands:
            try:
                found[command] = run(command, folder / "scene.ply", folder)
            except RuntimeError as error:
                found[command] = str(error)
    return found


def measure(g: Gaussians, commands: tuple[str, ...]) -> dict[str, Any]:
    """Return by command and move the largest relative difference, and where it is."""
    here, found = documents(g, commands), dict[str, Any]()
    for move in MOVES:
        there = documents(move(g), commands)
        for command in commands:
            row = found.setdefault(command, {})
            if isinstance(here[command], str) or isinstance(there[command], str):
                row[move.name] = {"failed": next(d[command] for d in (here, there) if isinstance(d[command], str))}
                print(f"{command:9}{move.name:24}   failed  {row[move.name]['failed']}", flush=True)
                continue
            apart, where, count = compare(here[command], there[command], move.scale)
            row[move.name] = {"largest": apart, "where": where, "numbers": count}
            print(f"{command:9}{move.name:24}{apart:9.2%}  {where}", flush=True)
    return found


def scenes(given: list[str], count: int, stated: bool) -> Iterator[tuple[str, Gaussians]]:
    """Yield the scenes: a built-in one with what is stated of it and without, or those given."""
    for name in given:
        kind, _, which = name.partition(":")
        if kind == "builtin":
            made = BUILTIN_SCENES[which](count, sh_degree=1).gaussians
            yield name, made.with_facts(load_source(name, None).gaussians.facts)
            if not stated:
                yield f"{which}, nothing stated", made.with_facts(SceneFacts())
        else:
            yield Path(name).stem, load_scene(name)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="*", default=["builtin:two_rooms"])
    parser.add_argument("--count", type=int, default=6000, help="Gaussians of a built-in scene")
    parser.add_argument("--stated", action="store_true", help="leave out the scene of which nothing is stated")
    parser.add_argument("--commands", nargs="+", default=list(COMMANDS), choices=list(COMMANDS))
    add_arguments(parser)
    arguments = parser.parse_args()
    looked_at = scenes(arguments.scenes, arguments.count, arguments.stated)
    found = {name: measure(g, tuple(arguments.commands)) for name, g in looked_at}
    figures = [
        {
            "name": f"largest difference, {scene}, {command}",
            "target": TARGET,
            "reached": max(row.get("largest", 1.0) for row in rows.values()),
            "unit": "of the number",
            "better": "lower",
        }
        for scene, by_command in found.items()
        for command, rows in by_command.items()
    ]
    question = "Does every command say the same of a scene that is turned, scaled or shifted?"
    write_result(arguments.out, question, figures, {"scenes": found})


if __name__ == "__main__":
    main()
