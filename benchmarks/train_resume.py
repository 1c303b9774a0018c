"""Does a training run that was killed and resumed end where one that was never killed ends?

`gsvis train` on bonsai at 200 x 133, killed with SIGKILL at moments drawn at random (seed 0), checkpoints every few
seconds, started again with the same command until it is done; compared with a run left alone, same command. A life ends
after a share of the time that the run left alone took, so that it is killed at work; each life says where it resumes.

Given: bonsai at 200 x 133, moments of kills.
Measured: difference of the result from that of a run left alone.
Defaults chosen on: no scene.
"""

from __future__ import annotations

import argparse
import json
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from _harness import add_arguments, realdata, write_result

_BETWEEN = (0.3, 0.6)  # length of a life over the time of the run left alone


def command(out: Path, iterations: int) -> list[str]:
    options = {"size": "200x133", "iterations": iterations, "max-gaussians": 80_000, "checkpoint-seconds": 5}
    words = [word for name, value in options.items() for word in (f"--{name}", str(value))]
    return [
        sys.executable,
        "-m",
        "gsvis",
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
        began = time.monotonic()
        subprocess.run(command(whole_at, arguments.iterations), check=True, capture_output=True)
        whole_s = time.monotonic() - began
        lives: list[float] = []
        found: list[int] = []
        log = Path(folder) / "log"
        for life in range(arguments.kills + 1):
            wanted = whole_s * float(rng.uniform(*_BETWEEN)) if life < arguments.kills else None
            began = time.monotonic()
            with log.open("w", encoding="utf-8") as file:
                run = subprocess.Popen(command(killed_at, arguments.iterations), stdout=subprocess.DEVNULL, stderr=file)
                try:
                    ended = run.wait(wanted) == 0
                except subprocess.TimeoutExpired:
                    ended = False
                    run.kill()
                    run.wait()
            lives.append(round(time.monotonic() - began, 1))
            found.append(read_resumed_step(log.read_text(encoding="utf-8")))
            print(f"life of {lives[-1]} s, resumed from step {found[-1]}", file=sys.stderr, flush=True)
            if ended:
                break
        if not killed_at.exists():
            raise SystemExit("the last life failed: " + log.read_text(encoding="utf-8")[-2000:])
        records = [document(path.with_suffix(".train.json").read_text()) for path in (whole_at, killed_at)]
        same = whole_at.read_bytes() == killed_at.read_bytes()
    counts, levels = zip(*(ends(record) for record in records), strict=True)
    figures = [
        {
            "name": f"bonsai, killed {len(lives) - 1} times and resumed: difference in final count",
            "target": 0.01,
            "reached": abs(counts[1] / counts[0] - 1.0),
            "unit": "of the count",
            "better": "lower",
        },
        {
            "name": f"bonsai, killed {len(lives) - 1} times and resumed: difference in held-out PSNR",
            "target": 0.05,
            "reached": abs(levels[1] - levels[0]),
            "unit": "dB",
            "better": "lower",
        },
    ]
    details = {"whole_s": whole_s, "lives_s": lives, "resumed_from": found, "steps": arguments.iterations}
    details |= {"counts": counts, "psnr": levels, "same_bytes": same}
    write_result(arguments.out, "Does a killed run end where another ends?", figures, details)


def read_resumed_step(text: str) -> int:
    """Return the step that a run resumed from; 0 if it began anew."""
    words = re.search(r"resuming from step ([\d,]+)", text)
    return int(words[1].replace(",", "")) if words else 0


def ends(record: dict[str, Any]) -> tuple[int, float]:
    """Final count and held-out PSNR of a record of `gsvis train`."""
    last = record["curve"][-1]
    return int(last["count"]), float(last["psnr"])


if __name__ == "__main__":
    main()
