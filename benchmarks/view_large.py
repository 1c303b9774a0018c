"""How soon does `gsvis view` show a large file that nobody has prepared, and how soon the whole of it?

`gsvis view` opens a binary PLY with SH of degree 3, as training writes it; headless Chromium without a GPU
(SwiftShader) opens its page as soon as the server listens. The first picture stands when the frame after the first draw
of quads begins. The scene is complete when the page says that it holds every Gaussian. Its picture stands when the page
takes away the picture of the sample, which it leaves until then.

Given: copies of nika LOD 0 side by side, as in `real_sizes.py`; the size of the window.
Measured: seconds from the start of the command until it listens, until the first picture, until the page holds the
    whole scene, and until it shows that; seconds of all cores, command and browser, until the page holds it; the peak
    of memory of the command's process.
    Modules are compiled to bytecode, as those of an installed package are: the first visit does it.
Defaults chosen on: the same copies.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from _cores import core_seconds
from _harness import add_arguments, need, write_result
from real_sizes import MILLION, build
from viewer_load import FIRST, FLAGS

TARGETS = {"first picture": 3.0, "complete": 20.0}
LIMIT_S = 600.0  # seconds until a visit is given up
_UNITS = {"": 1.0, "k": 1e3, "M": 1e6}


def main() -> None:
    """Open scenes of all sizes, and write the record."""
    parser = add_arguments(argparse.ArgumentParser(description=__doc__))
    parser.add_argument("--sizes", type=float, nargs="+", default=[2, 6], metavar="M", help="millions of Gaussians")
    parser.add_argument("--size", type=int, nargs=2, default=[640, 360])
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--work", type=Path, help="folder for scenes, kept")
    options = parser.parse_args()
    chromium = shutil.which("chromium")
    need(chromium, "Chromium on the PATH")
    runs: dict[str, list[dict[str, Any]]] = {}
    with tempfile.TemporaryDirectory() as temporary:
        work = options.work or Path(temporary)
        for millions in options.sizes:
            scene = work / f"copies_{millions:g}M.ply"
            if not scene.exists():
                build(scene, round(millions * MILLION))
            count = round(millions * MILLION)
            runs[f"{millions:g}M"] = [visit(scene, count, str(chromium), options.size) for _ in range(options.repeats)]
    figures = [
        {
            "name": f"{size}: {name}",
            "target": TARGETS.get(name) if size == "6M" else None,
            "reached": float(np.median([run[key] for run in found])),
            "unit": unit,
            "better": "lower",
        }
        for size, found in runs.items()
        for name, key, unit in (
            ("listens", "listens_s", "s"),
            ("first picture", "first_s", "s"),
            ("complete", "complete_s", "s"),
            ("picture of the whole", "shown_s", "s"),
            ("cores until complete", "cores_s", "s"),
            ("peak memory", "peak_gb", "GB"),
        )
    ]
    write_result(options.out, "How soon does `gsvis view` show a large file?", figures, {"runs": runs})


def visit(scene: Path, count: int, chromium: str, size: list[int]) -> dict[str, Any]:
    """Return the times of one start of the command, in seconds."""
    from playwright.sync_api import sync_playwright

    command = [sys.executable, "-m", "gsvis", "view", str(scene), "--no-browser", "--json", "--port", "0"]
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=list(FLAGS))
        page = browser.new_page(viewport={"width": size[0], "height": size[1]})
        page.add_init_script(FIRST)
        began, spent = time.perf_counter(), core_seconds()
        server = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, env=_compiling()
        )
        try:
            assert server.stdout is not None
            answer = ""
            while not answer.rstrip().endswith("}"):
                answer += server.stdout.readline()
            listens = time.perf_counter() - began
            page.goto(json.loads(answer)["url"], wait_until="commit")
            page.wait_for_function("() => window.drawn", timeout=1000 * LIMIT_S)
            first = time.perf_counter() - began
            while not _is_whole(page.locator(".state").inner_text(), count):
                if time.perf_counter() - began > LIMIT_S:
                    raise SystemExit(f"{scene.name}: the page does not hold {count:,} Gaussians after {LIMIT_S:g} s")
                page.wait_for_timeout(100)
            complete, spent = time.perf_counter() - began, core_seconds() - spent
            page.wait_for_function("() => !document.querySelector('.poster')", timeout=1000 * LIMIT_S)
            shown = time.perf_counter() - began
            peak = _peak_of(server.pid)
        finally:
            server.terminate()
            server.wait()
            browser.close()
    times = {"listens_s": listens, "first_s": first, "complete_s": complete, "shown_s": shown}
    return times | {"cores_s": spent, "peak_gb": peak}


def _compiling() -> dict[str, str]:
    """Return an environment in which Python keeps what it compiles."""
    return {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}


def _is_whole(said: str, count: int) -> bool:
    """Return whether the page says that it holds all Gaussians, to the digits that it shows."""
    found = re.fullmatch(r"([\d.]+) ?([kM]?) Gaussians", said.strip())
    return found is not None and abs(float(found[1]) * _UNITS[found[2]] / count - 1.0) < 0.01


def _peak_of(pid: int) -> float:
    """Return the largest resident memory of a process so far, GB."""
    status = Path(f"/proc/{pid}/status").read_text(encoding="utf-8")
    return int(status.partition("VmHWM:")[2].split()[0]) * 1024 / 1e9


if __name__ == "__main__":
    main()
