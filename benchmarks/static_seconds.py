"""How many seconds until a view is good: a static site in a browser, at delays of 10 to 100 ms, 10 and 30 Mbit/s?

A host of files (`_slow_host.py`) gives each visitor a delay, by which is meant a round trip, and a rate. The browser is
Debian's Chromium without a GPU, or Firefox ESR; each visit has an empty cache, in a window that stands open. What has
come is taken from the page's own Worker, with its time since navigation, and drawn here: the images are those of the
page without the time that this machine, which has no GPU, would need to draw. Page, scripts and tables count; the site
is opened at its first view, and at eyes within cells. Eyes from which the cell's own set does not draw the scene at
40 dB are left out, as in static_site.py: they may lie in furniture, and no server would send what they see first.

Given: a package with visible sets (--package), --eyes eyes drawn by --seed, --visits visits at each.
Measured: seconds from navigation until the image of what has come reaches 20 and 35 dB against all that the
    package holds in its highest level, 320 x 180, 65 degrees high; requests and bytes that had come whole by 35 dB,
    those of the page among them.
Defaults chosen on: nothing.
"""

from __future__ import annotations

import argparse
import itertools
import json
import tempfile
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from _browsers import visits
from _harness import add_arguments, first_reaching, need, write_result
from _slow_host import Host, slow_host
from static_site import Eye, camera_of, is_drawn, name_arrivals, package_ids, state_after, views_of

from gsvis.color.evaluate import Evaluator
from gsvis.export import write_site
from gsvis.package import Package
from gsvis.scene.gaussians import rotations_from_quats

DELAYS, RATES = (0.01, 0.03, 0.1), (10.0, 30.0)  # seconds, Mbit/s
TARGETS = (20.0, 35.0)
GOALS = {(0.03, 30.0): (1.5, 3.0), (0.1, 30.0): (3.0, 6.0)}
SIZE, WIDE = (320, 180), 97.1  # degrees: 65 high at 16 to 9
LONGEST = 9.0  # seconds of a visit

_WATCH = """
window.arrived = [];
const Real = Worker;
window.Worker = class extends Real {
  constructor(url, options) {
    super(url, options);
    if (!String(url).includes("static.js")) return;
    this.addEventListener("message", ({ data }) => {
      if (data.kind !== "batch") return;
      const { ids, owners, terms } = data.batch;
      const words = [...owners].flatMap((slot, k) => [slot, terms[2 * k], terms[2 * k + 1]]);
      window.arrived.push({ seconds: performance.now() / 1000, ids: [...ids], terms: words, gone: [] });
    });
  }
};
"""


def seconds_until(eye: Eye, steps: list[dict[str, Any]], target: float) -> float | None:
    """Seconds after which the image has a quality; found by halving, as quality hardly ever falls."""
    if not steps:
        return None
    first = first_reaching(lambda k: eye.quality(*state_after(eye, steps, k)), len(steps) - 1, target)
    return None if first is None else float(steps[first]["seconds"])


def address(pose: dict[str, Any]) -> str:
    """The part of an address behind # for a pose."""
    turn = rotations_from_quats(np.array([pose["rotation"]]))[0]
    to = np.array(pose["position"]) + 2.0 * turn[:, 2]
    return f"#eye={spell(pose['position'])}&to={spell(to)}&fov=65&mode=fly"


def spell(point: Iterable[float]) -> str:
    """A point as an address holds it."""
    return ",".join(f"{x:.6f}" for x in point)


def visit(
    browser: Any, host: Host, eye: Eye, at: str, ids: np.ndarray, contents: Any, link: tuple[float, float]
) -> dict[str, Any]:
    """Seconds to each target over a link of a delay and bytes a second, and bytes and requests until the last."""
    steps = browser(host.url + at, _WATCH, LONGEST, lambda: host.begin(*link))
    name_arrivals(steps, ids, contents)
    row: dict[str, Any] = {str(target): seconds_until(eye, steps, target) for target in TARGETS}
    end = row[str(TARGETS[-1])] or LONGEST
    done = [size for _, size, _, last in host.log if last <= end]
    return {**row, "requests": len(done), "bytes": sum(done), "gaussians": sum(len(step["ids"]) for step in steps)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    add_arguments(parser)
    parser.add_argument("--package", help="folder of a package with visible sets")
    parser.add_argument("--browsers", nargs="+", default=["chromium"], help="chromium, firefox")
    parser.add_argument("--eyes", type=int, default=4)
    parser.add_argument("--visits", type=int, default=3, help="visits at each eye")
    parser.add_argument("--seed", type=int, default=21)
    parser.add_argument("--delays", type=float, nargs="+", default=DELAYS)
    parser.add_argument("--rates", type=float, nargs="+", default=RATES)
    args = parser.parse_args()
    need(args.package, "--package, that `gsvis prepare` makes")
    figures: list[dict[str, Any]] = []
    rows = []
    with tempfile.TemporaryDirectory() as made_in, Package.open(args.package) as package:
        site = write_site(Path(made_in) / "site", package)
        contents, ids = package.contents, package_ids(package)
        evaluator = Evaluator(contents.colors().dequantize())
        said = json.loads((site.scene.path / "scene.json").read_bytes())["first"]
        starts = [{"pose": {key: first[key] for key in ("position", "rotation")}} for first in said]
        places = [
            ("first view", starts[:1]),
            ("eyes in cells", drawn_views(package, evaluator, args.eyes, args.seed)),
        ]
        with slow_host(Path(site.path)) as host:
            for name, delay, rate in itertools.product(args.browsers, args.delays, args.rates):
                # a browser for each link: Firefox stops answering after some visits
                with visits(name) as browser:
                    browser(host.url, _WATCH, 3.0, lambda: host.begin(0.0, 1e9))  # warms the machine up, not the cache
                    for place, views in places:
                        found = []
                        for view in views * args.visits:
                            eye = Eye(contents, evaluator, camera_of(view["pose"], SIZE, WIDE))
                            at = "" if place == "first view" else address(view["pose"])
                            row = visit(browser, host, eye, at, ids, contents, (delay, 125e3 * rate))
                            found.append(row)
                            rows.append({"browser": name, "delay": delay, "rate": rate, "place": place, **row})
                            print(rows[-1], flush=True)
                        where = f"{name}, {1000 * delay:.0f} ms, {rate:.0f} Mbit/s, {place}"
                        goals = GOALS.get((delay, rate), (None, None))
                        figures += summarize(where, found, LONGEST, goals)
    write_result(args.out, __doc__.splitlines()[0], figures, {"package": repr(package), "visits": rows})


def drawn_views(package: Package, evaluator: Evaluator, count: int, seed: int) -> list[dict[str, Any]]:
    """Up to `count` views from within cells whose sets draw them, of five times as many drawn by a seed."""
    found: list[dict[str, Any]] = []
    for view in views_of(package, 5 * count, np.random.default_rng(seed))[0]:
        eye = Eye(package.contents, evaluator, camera_of(view["pose"], SIZE, WIDE))
        if len(found) < count and is_drawn(package, eye, view["pose"]):
            found.append(view)
    return found


def summarize(
    name: str,
    rows: list[dict[str, Any]],
    longest: float,
    goals: tuple[float | None, float | None] = (None, None),
) -> list[dict[str, Any]]:
    """The figures of some visits, a median for each target; one that never had it counts as the longest."""
    out = []
    for target, goal in zip(TARGETS, goals, strict=True):
        values = [longest if row[str(target)] is None else row[str(target)] for row in rows]
        out.append(
            {
                "name": f"{name}: {target:.0f} dB",
                "target": goal, "reached": float(np.median(values)), "unit": "s", "better": "lower",
                "worst": max(values),
            }
        )  # fmt: skip
    return out


if __name__ == "__main__":
    main()
