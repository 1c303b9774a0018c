"""How long does gsvis take to start?

Starts Python processes in turn: one that does nothing, one that imports gsvis, one that prints `gsvis --help`.

Given: a warm file cache and compiled Python files.
Measured: wall time of each process, the median of 15; for `import gsvis` less that of the process that does nothing.
    Time of the processor, which other work on the machine stretches less, is in the JSON.
Defaults chosen on: no scene.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
from collections.abc import Sequence

import numpy as np
from _harness import add_arguments, measure_in_turn, write_result

STARTS = {
    "nothing": ("-c", "pass"),
    "import gsvis": ("-c", "import gsvis"),
    "gsvis --help": ("-m", "gsvis", "--help"),
}
TARGETS = {"import gsvis": 0.12, "gsvis --help": 0.5}


def start(words: Sequence[str]) -> None:
    """Run a Python process to its end."""
    subprocess.run([sys.executable, *words], check=True, stdout=subprocess.DEVNULL)


def processor_time(words: Sequence[str]) -> float:
    """Return the seconds of processor that a Python process takes."""
    before = os.times()
    start(words)
    after = os.times()
    return after.children_user + after.children_system - before.children_user - before.children_system


def main() -> None:
    parser = add_arguments(argparse.ArgumentParser(description=__doc__))
    parser.add_argument("--repeats", type=int, default=15)
    options = parser.parse_args()
    taken = measure_in_turn({name: lambda w=words: start(w) for name, words in STARTS.items()}, options.repeats)
    bare = taken["nothing"].median
    seconds = {"import gsvis": taken["import gsvis"].median - bare, "gsvis --help": taken["gsvis --help"].median}
    figures = [
        {"name": name, "target": TARGETS[name], "reached": value, "unit": "s", "better": "lower"}
        for name, value in seconds.items()
    ]
    processor = {n: float(np.median([processor_time(w) for _ in range(5)])) for n, w in STARTS.items()}
    write_result(options.out, "How long does gsvis take to start?", figures, {**taken, "processor_s": processor})


if __name__ == "__main__":
    main()
