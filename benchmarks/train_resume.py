"""Does a training run that was killed and gone on with end where one that was never killed ends?

`gsvis train` on bonsai at 200 x 133, killed with SIGKILL at moments drawn at random (seed 0), checkpoints every few
seconds, started again with the same command until it is done; compared with a run left alone, same command.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from _harness import add_arguments, realdata, write_result

_BETWEEN = (25.0, 60.0)  # seconds of a life


def command(out: Path, iterations: int) -> list[str]:
    options = {"size": "200x133", "iterations": iterations, "max-gaussians": 80_000, "checkpoint-seconds": 5}
    words = [word for name, value in options.items() for word in (f"--{name}", str(value))]
    return [
        sys.executable,
        "-m",
        "gsvis.cli",
        "train",
        str(realdata() / "photos/bonsai"),
        "-o",
        str(out),
        "--json",
        *words,
    ]


def document(text: str) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(text)
    return found


def main() -> None:
    parser = add_arguments(argparse.ArgumentParser(description=__doc__))
    parser.add_argument("--iterations", type=int, default=700)
    parser.add_argument("--kills", type=int, default=3)
    arguments = parser.parse_args()
    rng = np.random.default_rng(0)
    with tempfile.TemporaryDirectory() as folder:
        whole_at, killed_at = (Path(folder) / name / "scene.ply" for name in ("whole", "killed"))
        for path in (whole_at, killed_at):
            path.parent.mkdir()
        subprocess.run(command(whole_at, arguments.iterations), check=True, capture_output=True)
        lives = []
        for _ in range(arguments.kills):
            life = subprocess.Popen(
                command(killed_at, arguments.iterations), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
            )
            began, wanted = time.monotonic(), float(rng.uniform(*_BETWEEN))
            while life.poll() is None and time.monotonic() - began < wanted:
                time.sleep(0.05)
            ended = life.poll() is not None
            life.kill()
            life.wait()
            lives.append(round(time.monotonic() - began, 1))
            if ended:
                break
        subprocess.run(command(killed_at, arguments.iterations), check=True, capture_output=True)
        records = [document(path.with_suffix(".train.json").read_text()) for path in (whole_at, killed_at)]
        same = whole_at.read_bytes() == killed_at.read_bytes()
    counts, levels = zip(*(ends(record) for record in records), strict=True)
    figures = [
        {
            "name": f"bonsai, killed {len(lives)} times and gone on with: difference in final count",
            "target": 0.01,
            "reached": abs(counts[1] / counts[0] - 1.0),
            "unit": "of the count",
            "better": "lower",
        },
        {
            "name": f"bonsai, killed {len(lives)} times and gone on with: difference in held-out PSNR",
            "target": 0.05,
            "reached": abs(levels[1] - levels[0]),
            "unit": "dB",
            "better": "lower",
        },
    ]
    details = {"lives_s": lives, "counts": counts, "psnr": levels, "same_bytes": same}
    write_result(arguments.out, "Does a killed run end where another ends?", figures, details)


def ends(record: dict[str, Any]) -> tuple[int, float]:
    """Final count and held-out PSNR of a record of `gsvis train`."""
    last = record["curve"][-1]
    return int(last["count"]), float(last["psnr"])


if __name__ == "__main__":
    main()
