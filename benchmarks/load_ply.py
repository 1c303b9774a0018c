"""What does reading a PLY cost over the bare reading of its bytes?

A million Gaussians of SH degree 3 (248 MB, seeded noise). The peer is `np.fromfile` of the same bytes plus the
activations in NumPy (exp of the scales, sigmoid of the opacities, unit quaternions) and nothing else: no header, no
transposition of the SH, no checks. File cache warm, both in turn.

Given: a PLY of a million Gaussians of seeded noise.
Measured: time over the bare reading of its bytes in the same run.
Defaults chosen on: no scene.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np
from _harness import add_arguments, measure_in_turn, write_result

from gsvis.io import load_scene

NAMES = (
    ["x", "y", "z", "nx", "ny", "nz"]
    + [f"f_dc_{i}" for i in range(3)]
    + [f"f_rest_{i}" for i in range(45)]
    + ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
)


def write_noise(path: Path, count: int) -> int:
    """A PLY of noise; returns the size of its header."""
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {count}"]
    header = "\n".join([*lines, *(f"property float {name}" for name in NAMES), "end_header"]) + "\n"
    rng = np.random.default_rng(0)
    with path.open("wb") as out:
        out.write(header.encode("ascii"))
        for start in range(0, count, 1 << 16):
            rows = min(1 << 16, count - start)
            out.write(rng.standard_normal((rows, len(NAMES)), dtype=np.float32).tobytes())
    return len(header)


def bare(path: Path, offset: int) -> list[np.ndarray]:
    rows = np.fromfile(path, np.float32, offset=offset).reshape(-1, len(NAMES))
    opacity, scale, rot = NAMES.index("opacity"), NAMES.index("scale_0"), NAMES.index("rot_0")
    quats = rows[:, rot : rot + 4]
    return [
        rows,
        np.exp(rows[:, scale : scale + 3]),
        1.0 / (1.0 + np.exp(-rows[:, opacity])),
        quats / np.linalg.norm(quats, axis=1, keepdims=True),
    ]


def main() -> None:
    parser = add_arguments(argparse.ArgumentParser(description=__doc__))
    parser.add_argument("--count", type=int, default=1_000_000)
    parser.add_argument("--repeats", type=int, default=11)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "noise.ply"
        offset = write_noise(path, options.count)
        timings = measure_in_turn(
            {"bare": lambda: bare(path, offset), "load_scene": lambda: load_scene(path)}, options.repeats, warmup=2
        )
        size = path.stat().st_size
    ratio = timings["load_scene"].median / timings["bare"].median
    pairs = zip(timings["load_scene"].samples, timings["bare"].samples, strict=True)
    write_result(
        options.out,
        "What does reading a PLY cost over the bare reading of its bytes?",
        [
            {
                "name": f"load_scene over np.fromfile and activations, {options.count:,} Gaussians of SH degree 3",
                "target": 3.0,
                "reached": ratio,
                "unit": "times",
                "better": "lower",
            }
        ],
        {
            "file_bytes": size,
            "ratios_turn_by_turn": sorted(round(a / b, 3) for a, b in pairs),
            "gigabytes_per_second": size / timings["load_scene"].median / 1e9,
            **timings,
        },
    )


if __name__ == "__main__":
    main()
