"""How soon does a browser show a scene, from opening its page?

`gsvis view` serves a package on loopback; headless Chromium without a GPU (SwiftShader) opens its page. The first
picture is the time that the page's own statistics state; the scene is complete when the page says so, which it does
0.7 s and three round trips after the last batch: that wait is taken off.

Given: a package (`--package`), the size of the window.
Measured: seconds from navigation to the first picture and to the last batch; Gaussians that had come by then; seconds
    of all cores, server and browser, until the page says that it is complete.
Defaults chosen on: nothing.
"""

from __future__ import annotations

import argparse
import json
import re
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from _cores import core_seconds
from _harness import add_arguments, need, write_result

FLAGS = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader")
COMPLETE = """() => new Promise((done) => {
    const look = () => /^[0-9.]+ .*Gaussians$/.test(document.querySelector('.state')?.textContent ?? '') && done();
    new MutationObserver(look).observe(document, { subtree: true, childList: true, characterData: true });
    look();
})"""
STILL = 0.7  # seconds without a batch after which the page calls a scene complete


def main() -> None:
    parser = add_arguments(argparse.ArgumentParser(description=__doc__))
    parser.add_argument("--package", type=Path)
    parser.add_argument("--size", type=int, nargs=2, default=[640, 360])
    parser.add_argument("--repeats", type=int, default=5)
    options = parser.parse_args()
    need(options.package, "a package: --package scene.gsvis")
    chromium = shutil.which("chromium")
    need(chromium, "Chromium on the PATH")
    command = [sys.executable, "-m", "gsvis", "view", str(options.package), "--no-browser", "--json", "--port", "0"]
    server = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        assert server.stdout is not None
        answer = ""
        while not answer.rstrip().endswith("}"):
            answer += server.stdout.readline()
        runs = visit(json.loads(answer)["url"], str(chromium), options)
    finally:
        server.terminate()
        server.wait()
    first = float(np.median([run["first_s"] for run in runs]))
    complete = float(np.median([run["complete_s"] for run in runs]))
    cores = float(np.median([run["cores_s"] for run in runs]))
    figures = [
        {"name": "first picture", "target": 1.0, "reached": first, "unit": "s", "better": "lower"},
        {"name": "complete", "target": 1.5, "reached": complete, "unit": "s", "better": "lower"},
        {"name": "cores until complete", "target": None, "reached": cores, "unit": "s", "better": "lower"},
    ]
    details = {"package": options.package.name, "size": options.size, "runs": runs}
    write_result(options.out, "How soon does a browser show a scene?", figures, details)


def visit(url: str, chromium: str, options: argparse.Namespace) -> list[dict[str, Any]]:
    """Open the page again and again, each time as a new visitor."""
    from playwright.sync_api import sync_playwright

    width, height = options.size
    runs = []
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=list(FLAGS))
        for _ in range(options.repeats + 1):
            page = browser.new_page(viewport={"width": width, "height": height})
            began, spent = time.perf_counter(), core_seconds()
            page.goto(url, wait_until="commit")
            page.evaluate(COMPLETE)
            complete, spent = time.perf_counter() - began - STILL, core_seconds() - spent
            page.keyboard.press("t")
            text = page.locator(".statistics").inner_text()
            found = re.search(r"([0-9.]+) s", text)
            runs.append({
                "first_s": float(found.group(1)) if found else None, "complete_s": complete, "cores_s": spent,
                "said": page.locator(".state").inner_text(), "statistics": text,
            })  # fmt: skip
            page.close()
        browser.close()
    return runs[1:]  # the first loads everything anew


if __name__ == "__main__":
    main()
