"""Kill commands at random moments, resume them, and compare what they end with: `python tools/kill.py --kills 100`.

Each command runs twice left alone: the first run warms the caches, the second gives the time and the bytes to compare
with. Then it is started in a folder of its own, its whole process group ended with SIGKILL, and started again with the
same words until it ends by itself, up to three kills a folder. Moments are drawn over the time of the run left alone,
one from each of as many equal parts as there are kills, so that early, middle and late stages are all hit. Scenes are
built in, photographs are drawn by rule. `timings.json` and the section `timing` of a training record hold times: they
are left out of the comparison, and nothing else is.

Given: the scene, the photographs, the words of each command, the seed.
Measured: kills that hit a run, results that differ, files left behind.
Defaults chosen on: the built-in scene two_rooms, thinned to an eighth.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "benchmarks")]

from _harness import add_arguments, write_result  # noqa: E402

from gsvis.io import save_scene  # noqa: E402
from gsvis.scene.cameras import Cameras  # noqa: E402
from gsvis.scene.procedural import BUILTIN_SCENES  # noqa: E402

MOST_KILLS = 3
"""Kills of one folder before it is left to finish."""

REFUSED = 2
"""Exit code of a command that does not begin."""

HANG = 900.0
"""Seconds after which a run counts as hung: far more than any takes."""

VIEWS = ["--views", "4", "--width", "48", "--height", "36"]
COMMANDS: dict[str, list[str]] = {
    "pvs": ["pvs", "{scene}", "-o", "out.pvs", "--cells", "8", "--face-size", "32", "--certify", "512", "--max-inner",
            "2", "--workers", "2"],
    "levels": ["levels", "{scene}", "-o", "out", "--steps", "24", "--views", "6", "--held-out", "2",
               "--width", "48", "--height", "36"],
    "color": ["color", "{scene}", "-o", "out.arrow", *VIEWS, "--held-out", "2", "--max-terms", "2",
              "--report", "report"],
    "train": ["train", "../photos", "-o", "out.ply", "--steps", "120", "--evaluate-every", "40",
              "--random-points", "1000", "--checkpoint-seconds", "1"],
    "prepare": ["prepare", "{scene}", "-o", "out.gsvis", "--steps", "6", "--views", "4", "--width", "48", "--height",
                "36", "--cells", "4", "--face-size", "32", "--limit", "0.01", "--max-inner", "2", "--workers", "2",
                "--max-terms", "1"],
    "convert": ["convert", "{scene}", "out.sog"],
    "analyze": ["analyze", "{scene}", "-o", "out", *VIEWS, "--traced-sample", "200", "--rays-per-face", "1"],
}  # fmt: skip
"""The words of each command, run in a folder of its own beside its input."""


@dataclass
class Tally:
    """What the kills of one command came to.

    Attributes:
        kills: Kills that hit a run; those drawn for a moment at which it had ended do not count.
        missed: Moments at which the run had ended.
        moments: Of the kills, as shares of the time of a run left alone.
        folders: Results that were compared.
        differences: What differs, in words.
        leftovers: Names of what only a killed run leaves.
        temporary: Entries that killed runs left in the folder for temporary files.
        refused: Times that the whole result was there already, so that the same command asked for `--overwrite`.
    """

    alone_s: float
    kills: int = 0
    missed: int = 0
    moments: list[float] = field(default_factory=list)
    folders: int = 0
    differences: list[str] = field(default_factory=list)
    leftovers: list[str] = field(default_factory=list)
    temporary: int = 0
    refused: int = 0


def main() -> None:
    parser = add_arguments(argparse.ArgumentParser(description=__doc__))
    parser.add_argument("--kills", type=int, default=100, help="in all, shared among the commands")
    parser.add_argument("--commands", nargs="+", choices=COMMANDS, default=[*COMMANDS])
    parser.add_argument("--scene", choices=BUILTIN_SCENES, default="two_rooms", help="a built-in scene")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    tallies: dict[str, Tally] = {}
    with tempfile.TemporaryDirectory(prefix="gsvis-kill-") as folder:
        base = Path(folder)
        write_photos(base / "photos")
        save_scene(BUILTIN_SCENES[options.scene]().gaussians[::8], base / "scene.ply")
        for k, command in enumerate(options.commands):
            share = options.kills // len(options.commands) + (k < options.kills % len(options.commands))
            rng = np.random.default_rng([options.seed, [*COMMANDS].index(command)])
            tallies[command] = kill_often(command, base, share, rng)
    figures = [
        figure("kills that hit a run", sum(t.kills for t in tallies.values()), None, "higher", "kills"),
        figure("results that differ", sum(len(t.differences) for t in tallies.values()), 0, "lower", "differences"),
        figure("files left behind", sum(len(t.leftovers) for t in tallies.values()), 0, "lower", "files"),
    ]
    details: dict[str, Any] = {"seed": options.seed, "scene": options.scene, "most_kills_of_a_folder": MOST_KILLS}
    details["notes"] = [
        "Input: the scene, the words of each command, the seed. Measured: everything under commands.",
        "Not compared: timings.json, and the section timing of a training record.",
        "temporary counts entries left in TMPDIR, which the system clears; no command resumes from there.",
    ]
    details["commands"] = {name: vars(tally) | {"words": words(name)} for name, tally in tallies.items()}
    question = "Does a command that is killed and resumed end with the bytes of one that is left alone?"
    write_result(options.out, question, figures, details)
    if any(tally.differences or tally.leftovers for tally in tallies.values()):
        raise SystemExit(1)


def figure(name: str, reached: float, target: float | None, better: str, unit: str) -> dict[str, Any]:
    return {"name": name, "target": target, "reached": reached, "unit": unit, "better": better}


def words(command: str) -> list[str]:
    """Return the words of a command: the same ones each time, as a user repeats them."""
    return [word.replace("{scene}", "../scene.ply") for word in COMMANDS[command]]


GSVIS = [sys.executable, "-m", "gsvis"]


def kill_often(command: str, base: Path, kills: int, rng: np.random.Generator) -> Tally:
    """Kill a command as often as asked, and compare what it ends with."""
    said = words(command)
    alone = [base / f"{command}-alone-{k}" for k in range(2)]
    for folder in alone:
        began = time.monotonic()
        code, text = left_alone(said, folder)
        if code:
            raise SystemExit(f"{command} fails without a kill: exit code {code}, {text}")
        taken = time.monotonic() - began
    tally = Tally(round(taken, 2))
    wanted = contents(alone[1])
    tally.differences += [f"two runs left alone: {d}" for d in differences(contents(alone[0]), wanted)]
    moments = [*rng.permutation((np.arange(kills) + rng.random(kills)) / kills)]
    while tally.kills < kills:
        folder = base / f"{command}-killed"
        for _ in range(int(rng.integers(1, MOST_KILLS + 1))):
            if tally.kills == kills:
                break
            moment = float(moments.pop() if moments else rng.random())
            if not killed_after(moment * taken, said, folder):
                tally.missed += 1
                break
            tally.kills += 1
            tally.moments.append(round(moment, 3))
        code, text = left_alone(said, folder)
        found = contents(folder)
        where = f"after {tally.kills} kills"
        different = differences(found, wanted)
        if code == REFUSED and not different:  # the kill came after the result: it is not replaced without leave
            tally.refused += 1
        elif code:
            tally.differences.append(f"{where}: the same command fails: exit code {code}, {text}")
        tally.differences += [f"{where}: {difference}" for difference in different]
        tally.leftovers += [f"{where}: {name}" for name in found if name not in wanted]
        tally.temporary += sum(1 for _ in (folder / "tmp").iterdir())
        tally.folders += 1
        shutil.rmtree(folder)
        message = f"{command}: {tally.kills} of {kills}, {len(tally.differences)} differ, {len(tally.leftovers)} left"
        print(message, file=sys.stderr, flush=True)
    return tally


def started(said: list[str], folder: Path) -> subprocess.Popen[bytes]:
    """A command started in its folder, in a process group of its own, temporary files beside."""
    (folder / "work").mkdir(parents=True, exist_ok=True)
    (folder / "tmp").mkdir(exist_ok=True)
    for name in ("scene.ply", "photos"):
        if not (folder / name).exists():
            (folder / name).symlink_to(folder.parent / name)
    environment = {**os.environ, "TMPDIR": str(folder / "tmp"), "PYTHONPATH": str(ROOT), "GSVIS_DEBUG": "0"}
    with (folder / "log").open("ab") as log:
        return subprocess.Popen(
            [*GSVIS, *said], cwd=folder / "work", env=environment, stdout=log, stderr=log, start_new_session=True
        )


def left_alone(said: list[str], folder: Path) -> tuple[int, str]:
    """Run a command to its end; return its exit code and the last of what it said."""
    process = started(said, folder)
    try:
        code = process.wait(HANG)
    except subprocess.TimeoutExpired:
        return end(process), f"it hung for {HANG:g} s"
    return code, (folder / "log").read_text(encoding="utf-8", errors="replace").strip()[-300:]


def killed_after(seconds: float, said: list[str], folder: Path) -> bool:
    """Run a command and kill it after so many seconds; False if it ended before."""
    process = started(said, folder)
    try:
        process.wait(seconds)
    except subprocess.TimeoutExpired:
        return end(process) == -signal.SIGKILL
    return False


def end(process: subprocess.Popen[bytes]) -> int:
    """Kill the whole group of a process; its exit code."""
    os.killpg(process.pid, signal.SIGKILL)
    return process.wait()


def contents(folder: Path) -> dict[str, bytes]:
    """All files of a result by name, hidden ones and empty folders too, without the times in them."""
    work = folder / "work"
    found = {}
    for path in sorted(work.rglob("*")):
        name = path.relative_to(work).as_posix()
        found[name] = b"" if path.is_dir() or path.name == "timings.json" else path.read_bytes()
        if name.endswith(".train.json"):
            record = json.loads(found[name])
            record.pop("timing", None)
            found[name] = json.dumps(record).encode()
    return found


def differences(found: dict[str, bytes], wanted: dict[str, bytes]) -> list[str]:
    """What a result lacks or has otherwise."""
    missing = [f"{name} is missing" for name in wanted if name not in found]
    return missing + [f"{name} differs" for name in wanted if name in found and found[name] != wanted[name]]


def write_photos(folder: Path, count: int = 12, width: int = 64, height: int = 48) -> None:
    """`transforms.json` and `images`: smooth pictures from cameras on a circle."""
    (folder / "images").mkdir(parents=True)
    views = Cameras.orbit((0.0, 0.0, 0.0), 4.0, count, width=width, height=height, fov=60.0)
    x, y = np.meshgrid(np.linspace(0.0, 1.0, width), np.linspace(0.0, 1.0, height))
    frames = []
    for k, pose in enumerate(views.viewmats):
        waves = [np.sin(6.3 * (x + 0.1 * k)), np.cos(6.3 * (y - 0.1 * k)), x * y]
        picture = np.round(127.5 + 100.0 * np.stack(waves, axis=-1)).astype(np.uint8)
        Image.fromarray(picture).save(folder / "images" / f"{k:03d}.png")
        world_from_camera = np.linalg.inv(pose) @ np.diag([1.0, -1.0, -1.0, 1.0])
        frames.append({"file_path": f"images/{k:03d}.png", "transform_matrix": world_from_camera.tolist()})
    content = {"camera_angle_x": float(np.radians(60.0)), "w": width, "h": height, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(content), encoding="utf-8")


if __name__ == "__main__":
    main()
