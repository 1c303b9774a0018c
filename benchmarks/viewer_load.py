"""How soon does a browser show a scene, from opening its page?

`gsvis view` serves a package on loopback; headless Chromium without a GPU (SwiftShader) opens its page. The first
picture stands when the frame after the first draw of quads begins, counted from navigation; the scene is complete when
the page says so, which it does 0.7 s and three round trips after the last batch: 0.7 s are taken off.

Given: a package (`--package`), the size of the window.
Measured: seconds from navigation to the first picture and to the last batch; Gaussians that had come by then; seconds
    of all cores, server and browser, until the page says that it is complete. In visits of their own, whose network
    Worker reports: seconds from navigation to the first pose, and from there to the arrival of the last message; in a
    window of 64 x 36 pixels too, where drawing takes nearly nothing.
Defaults chosen on: nothing.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from _cores import core_seconds
from _harness import add_arguments, need, write_result
from _watched import FLAGS as WATCHED
from _watched import heard, watch

from gsvis.stream.wire import PoseAt

FLAGS = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader")
COMPLETE = """() => new Promise((done) => {
    const look = () => /^[0-9.]+ .*Gaussians$/.test(document.querySelector('.state')?.textContent ?? '') && done();
    new MutationObserver(look).observe(document, { subtree: true, childList: true, characterData: true });
    look();
})"""
FIRST = """
const draw = WebGL2RenderingContext.prototype.drawElementsInstanced;
WebGL2RenderingContext.prototype.drawElementsInstanced = function (...given) {
  if (!window.drawn) requestAnimationFrame(() => { window.drawn ??= performance.now(); });
  return draw.apply(this, given);
};
"""
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
        url = json.loads(answer)["url"]
        runs = visit(url, str(chromium), options)
        watched = {
            f"{size[0]} x {size[1]}": listen(url, str(chromium), size, options.repeats)
            for size in (options.size, [64, 36])
        }
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
    for size, times in watched.items():
        for name, key in (("first pose", "pose_s"), ("from the first pose to the last message", "wire_s")):
            median = float(np.median([one[key] for one in times]))
            figures.append(
                {"name": f"{size}: {name}", "target": None, "reached": median, "unit": "s", "better": "lower"}
            )
    details = {"watched": watched, "package": options.package.name, "size": options.size, "runs": runs}
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
            page.add_init_script(FIRST)
            began, spent = time.perf_counter(), core_seconds()
            page.goto(url, wait_until="commit")
            page.evaluate(COMPLETE)
            complete, spent = time.perf_counter() - began - STILL, core_seconds() - spent
            page.wait_for_function("() => window.drawn")
            page.keyboard.press("t")
            text = page.locator(".statistics").inner_text()
            runs.append({
                "first_s": page.evaluate("window.drawn") / 1000, "complete_s": complete, "cores_s": spent,
                "said": page.locator(".state").inner_text(), "statistics": text,
            })  # fmt: skip
            page.close()
        browser.close()
    return runs[1:]  # the first loads everything anew


def listen(url: str, chromium: str, size: list[int], repeats: int) -> list[dict[str, float]]:
    """Return when the first pose was sent and when the last message had come, of some visits."""
    from playwright.sync_api import sync_playwright

    found = []
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=list(WATCHED))
        for _ in range(repeats + 1):
            page = browser.new_page(viewport={"width": size[0], "height": size[1]})
            watch(page)
            began = time.time()
            page.goto(url, wait_until="commit")
            page.evaluate(COMPLETE)
            sent, came = heard(page)
            pose = next(at for at, message in sent if isinstance(message, PoseAt))
            last, total = max(at for at, _ in came), sum(size for _, size in came)
            found.append({"pose_s": pose - began, "wire_s": last - pose, "bytes": total})
            page.close()
        browser.close()
    return found[1:]


if __name__ == "__main__":
    main()
