"""How long does `gsvis analyze` take on real scenes, reading and report included?

The whole process, as a user starts it, with compiled kernels already in numba's cache.

Given: showroom LOD 3, nika LOD 0; 16 views of 256 x 192; compiled kernels.
Measured: seconds of the whole process.
Defaults chosen on: no scene: the limits are of the plan.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time

from _harness import add_arguments, realdata, write_result

SCENES = (("showroom", 3, 180.0), ("nika_sh3", 0, 180.0))


def main() -> None:
    options = add_arguments(argparse.ArgumentParser(description=__doc__)).parse_args()
    figures = []
    for name, lod, target in SCENES:
        path = realdata() / "scenes" / name / "lod-meta.json"
        with tempfile.TemporaryDirectory() as folder:
            command = [sys.executable, "-m", "gsvis", "analyze", str(path), "--lod", str(lod), "-o", folder]
            start = time.perf_counter()
            subprocess.run([*command, "--views", "16", "--json"], check=True, capture_output=True)
            seconds = time.perf_counter() - start
        figures.append({"name": f"gsvis analyze, {name} LOD {lod}, 16 views of 256 x 192, whole process",
                        "target": target, "reached": seconds, "unit": "s", "better": "lower"})  # fmt: skip
    write_result(options.out, "How long does gsvis analyze take?", figures, {})


if __name__ == "__main__":
    main()
