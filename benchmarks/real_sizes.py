"""What do the commands cost on scenes of a real size: millions of Gaussians with SH of degree 3?

A scene of N million Gaussians is written as a PLY: copies of one trained scene side by side, each turned, and moved a
little Gaussian by Gaussian. Each command then runs with its defaults, a worker for each core, and records its stages.

Given: nika LOD 0 (SH 3) without its outermost percent, as often as needed; commands with their defaults.
Measured: processor seconds, wall seconds and peak memory of each stage, all processes together; ratios between sizes
    say how the cost grows. The machine may be shared: processor seconds count.
Defaults chosen on: no scene; copies of one scene are no district, and hide each other less than walls of rooms do.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from _harness import add_arguments, realdata, write_result

from gsvis.io.ply import save_ply_parts
from gsvis.io.sources import load_source
from gsvis.scene.gaussians import Gaussians

SOURCE = "nika_sh3/lod-meta.json"
MILLION = 1_000_000
COMMANDS: dict[str, tuple[str, ...]] = {  # words after the name of the scene
    "prepare": ("-o", "out.gsvis", "--json"),
    "convert": ("out.spz",),
    "clean": ("-o", "out.ply"),
    "analyze": ("-o", "out"),
}
_MIDDLE = 0.99  # share of the centers kept on each axis
_PITCH = 0.9  # share of the centers whose extent is the way from a copy to the next: what is thin overlaps
_JITTER = 0.3  # standard deviations of a Gaussian that its center moves, RMS
_HALF_TURN = np.diag([-1.0, 1.0, -1.0])  # about the up axis of the source, -y
SEED = 47


def main() -> None:
    """Build the scenes, run the commands, write the record."""
    parser = add_arguments(argparse.ArgumentParser(description=__doc__))
    parser.add_argument("--sizes", type=float, nargs="+", default=[0.3, 0.6], metavar="M", help="millions of Gaussians")
    parser.add_argument("--commands", nargs="+", choices=COMMANDS, default=["prepare"])
    parser.add_argument("--words", default="", help="more words for the commands, such as '--cells 4 --steps 12'")
    parser.add_argument("--threads", type=int, default=2, help="threads of each command")
    parser.add_argument("--work", type=Path, help="folder for scenes, kept, and what is made of them")
    options = parser.parse_args()
    runs: dict[str, dict[str, Any]] = {}
    with tempfile.TemporaryDirectory() as temporary:
        work = options.work or Path(temporary)
        for size in options.sizes:
            scene = work / f"copies_{size:g}M.ply"
            if not scene.exists():
                build(scene, round(size * MILLION))
            shutil.rmtree(work / f"{size:g}M", ignore_errors=True)  # of an earlier run
            runs[f"{size:g}M"] = {
                command: run([command, str(scene), *options.words.split()], work / f"{size:g}M", options.threads)
                for command in options.commands
            }
    figures = [figure for size, found in runs.items() for figure in figures_of(size, found)]
    write_result(options.out, "What do commands cost on scenes of a real size?", figures, {"runs": runs})


def build(target: Path, count: int) -> None:
    """Write a scene of `count` Gaussians: copies of the source on a square grid."""
    source = load_source(str(realdata() / "scenes" / SOURCE), 0).gaussians
    low, high = source.bounds(_MIDDLE)
    core = source[np.flatnonzero(np.all((source.means >= low) & (source.means <= high), axis=1))]
    copies = math.ceil(count / len(core))
    side = math.ceil(math.sqrt(copies))
    near, far = source.bounds(_PITCH)
    rng = np.random.default_rng(SEED)
    parts = []
    for k, own in enumerate(np.diff(np.arange(copies + 1) * count // copies)):
        some = core[np.sort(rng.permutation(len(core))[:own])]
        place = np.array([k % side, 0.0, k // side]) * (far - near)
        parts.append(_jitter(_turn(some, (low + high) / 2.0, half=k % 2 == 1, place=place), rng))
    target.parent.mkdir(parents=True, exist_ok=True)
    save_ply_parts(parts, target, count, core.sh_degree, core.facts)


def _turn(g: Gaussians, middle: np.ndarray[Any, Any], *, half: bool, place: np.ndarray[Any, Any]) -> Gaussians:
    """Return a copy moved to a place, turned about its middle by a half turn if asked for."""
    rotation = _HALF_TURN if half else np.eye(3)
    return g.transform(rotation, place + middle - rotation @ middle)


def _jitter(g: Gaussians, rng: np.random.Generator) -> Gaussians:
    """Return Gaussians whose centers moved by a part of their size."""
    moves = _JITTER * rng.normal(size=g.means.shape) * g.scales.min(axis=1, keepdims=True)
    return Gaussians(g.means + moves, g.quats, g.scales, g.opacities, g.sh0, g.shN, facts=g.facts)


def run(words: list[str], folder: Path, threads: int) -> dict[str, Any]:
    """Run a command in a process of its own; return its stages, and all of them together."""
    folder.mkdir(parents=True, exist_ok=True)
    command = words[0]
    record = folder / f"{command}.json"
    words = [*words, *(str(folder / word) if word.startswith("out") else word for word in COMMANDS[command])]
    held = {name: str(threads) for name in ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS")}
    script = Path(__file__).with_name("_metered.py")
    with open(folder / f"{command}.out", "wb") as out:
        subprocess.run(
            [sys.executable, str(script), str(record), *words], stdout=out, env={**os.environ, **held}, check=True
        )
    stages = json.loads(record.read_text())
    whole = {
        "wall_s": sum(each["wall_s"] for each in stages),
        "cpu_s": sum(each["cpu_s"] for each in stages),
        "peak_gb": max(each["peak_gb"] for each in stages),
    }
    return {**whole, "load": os.getloadavg()[0], "stages": stages}


def figures_of(size: str, runs: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the figures of one size."""
    targets: dict[str, dict[str, float]] = {"2M": {"wall_s": 1200.0}, "6M": {"wall_s": 3600.0, "peak_gb": 6.0}}
    return [
        {
            "name": f"{size}: {command}, {what}",
            "target": targets.get(size, {}).get(key) if command == "prepare" else None,
            "reached": found[key],
            "unit": unit,
            "better": "lower",
        }
        for command, found in runs.items()
        for key, what, unit in (
            ("wall_s", "time", "s"),
            ("cpu_s", "processor time", "s"),
            ("peak_gb", "peak memory", "GB"),
        )
    ]


if __name__ == "__main__":
    main()
