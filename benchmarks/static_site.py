"""How many bytes does a page need until a view is good: a static site beside the streaming server?

Both send to an eye that stands still in a cell, over a link of 10 Mbit/s with a round trip of 40 ms. The server is a
`Session` whose messages are acknowledged when they have arrived. The static side is the page's own reader (TypeScript,
run by node) with files behind a simulated link: scene.json, tables and rows of cells count as well as records. Bytes
are those of messages and of the bodies of answers; headers of HTTP are not counted, but requests are. A Gaussian has
the color of those of its terms that have come. Eyes from which the cell's own set does not draw the scene at 40 dB
(they may lie in furniture) are left out. First views, for which a site has a file of its own, are judged beside the
others. The same reader reads the same site once more without its glances, eye by eye.

Given: a package with visible sets (--package), --eyes centers of cells and directions drawn by --seed.
Measured: bytes until the image of what has come reaches 35 dB (25 and 30 too) against that of all that the package
    holds in its highest level with all terms, 320 x 224, 90 degrees wide; their ratio; requests. Bytes until the first
    block has come, what is on its way beside it among them.
Defaults chosen on: seven eyes of seed 101 in showroom: what the sphere of a part is. 27 eyes of seeds 77, 2029 and 5077
    there: how spheres count in view, and those of cells. Nine eyes of seed 611 there: sectors and bytes of glances.
    Sizes of parts and strata on other eyes of showroom. Nothing was chosen on nika.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from _harness import add_arguments, first_reaching, need, write_result
from _reader import build_reader

from gsvis.abr import FieldOfView
from gsvis.color.evaluate import Evaluator
from gsvis.export import write_static
from gsvis.export.lights import Lights
from gsvis.export.parts import divide_in_space
from gsvis.export.placing import Placing
from gsvis.package import Package
from gsvis.package.contents import Contents
from gsvis.render import psnr, rasterize
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import quats_from_rotations, rotations_from_quats
from gsvis.stream import Session, StreamedScene

RATE, ROUND_TRIP = 1.25e6, 0.04
TARGETS = (25.0, 30.0, 35.0)
TANGENTS = (1.0, 1.0, 0.7, 0.7)  # left, right, up, down
SIZE = (320, 224)
WITHIN = 0.35  # sides of a cell from its middle


class Eye:
    """A view of a package, and how well a part of it draws it."""

    def __init__(self, contents: Contents, evaluator: Evaluator, camera: Cameras) -> None:
        self.evaluator, self.camera, self.g = evaluator, camera, contents.gaussians()
        top = contents.last == len(contents.names) - 1
        self.reference = self.draw(top, np.ones(len(contents.term_records), bool))

    def draw(self, held: np.ndarray, terms: np.ndarray) -> np.ndarray:
        rgb = self.evaluator.colors(self.g.means, self.camera.viewpoints[0], active=terms)[held]
        image = rasterize(self.g[held], self.camera, colors=np.ascontiguousarray(rgb)).images[0]
        return np.clip(image, 0.0, 1.0)

    def quality(self, held: np.ndarray, terms: np.ndarray) -> float:
        return float(psnr(self.draw(held, terms), self.reference))


def is_drawn(package: Package, eye: Eye, pose: dict[str, Any]) -> bool:
    """Return whether what the cell of a pose sees draws the scene from there at 40 dB."""
    contents, grid = package.contents, package.visibility.grid
    seen = np.zeros(len(contents), bool)
    seen[package.visibility.visible_ids(grid.nearest(np.array(pose["position"])))] = True
    top = contents.last == len(contents.names) - 1
    return eye.quality(seen & top, np.ones(len(contents.term_records), bool)) >= 40.0


def first_bytes(eye: Eye, steps: list[dict[str, Any]]) -> dict[float, tuple[int, int]]:
    """Bytes and requests after which each target is met; states are ranked by halving, as quality hardly ever falls."""
    found: dict[float, tuple[int, int]] = {}
    known: dict[int, float] = {}

    def quality(k: int) -> float:
        if k not in known:
            known[k] = eye.quality(*state_after(eye, steps, k))
        return known[k]

    for target in TARGETS:
        first = first_reaching(quality, len(steps) - 1, target)
        if first is not None:
            found[target] = steps[first]["bytes"], steps[first]["requests"]
    return found


def state_after(eye: Eye, steps: list[dict[str, Any]], last: int) -> tuple[np.ndarray, np.ndarray]:
    held, terms, slots = np.zeros(len(eye.g), bool), np.zeros(eye.evaluator.num_terms, bool), []
    for step in steps[: last + 1]:
        slots += step["ids"]
        held[step["ids"]] = True
        terms[step["terms"]] = True
        held[[slots[s] for s in step["gone"]]] = False
    return held, terms


def name_arrivals(steps: list[dict[str, Any]], ids: np.ndarray, contents: Contents) -> None:
    """Replace ids of the static form, and slots and records of terms, by ids of the package."""
    padded = np.zeros((len(contents.term_records), 8), np.uint8)
    padded[:, : contents.term_records.shape[1]] = contents.term_records
    records, offsets, slots = padded.view("<u8")[:, 0], contents.term_offsets, []
    for step in steps:
        step["ids"] = ids[step["ids"]].tolist()
        slots += step["ids"]
        found = []
        for slot, low, high in np.array(step["terms"], np.uint64).reshape(-1, 3).tolist():
            first, last = offsets[slots[slot]], offsets[slots[slot] + 1]
            found += (first + np.flatnonzero(records[first:last] == low + (high << 32))).tolist()
        step["terms"] = found


def stream(scene: StreamedScene, camera: Cameras, pose: dict[str, Any]) -> list[dict[str, Any]]:
    """Arrivals of a streaming session."""
    session = Session(scene, FieldOfView(*TANGENTS, margin=0.14))
    now, free, due, steps = 0.0, 0.0, [], []
    welcome = session.welcome(0.0)
    total, arrived, slots = len(welcome.data), 0.0, {}
    free = ROUND_TRIP / 2 + total / RATE
    due.append((free + ROUND_TRIP / 2, 0, total, None))
    while True:
        session.on_pose(now + 1e-6, pose["position"], pose["rotation"])
        while (message := session.next_message(now)) is not None:
            free = max(free, now + ROUND_TRIP / 2) + len(message.data) / RATE
            due.append((free + ROUND_TRIP / 2, message.sequence, len(message.data), message.batch))
        if not due:
            break
        now, sequence, size, batch = due.pop(0)
        session.on_ack(now, sequence)
        arrived += size
        if batch is None:
            continue
        fresh = batch.gaussians.tolist()
        slots.update({g: len(slots) + k for k, g in enumerate(fresh)})
        gone = [slots[g] for g in batch.dropped.tolist() if g in slots]
        row = {"bytes": int(arrived), "requests": 1, "seconds": now, "ids": fresh, "gone": gone}
        steps.append({**row, "terms": batch.terms.tolist()})
    return steps


def trace(folder: Path, views: list[dict[str, Any]], script: Path) -> list[list[dict[str, Any]]]:
    """Arrivals of the page's reader, for each view."""
    words = ["node", str(script), str(folder), str(RATE), str(ROUND_TRIP), "1e12"]
    found = subprocess.run(words, input=json.dumps(views), capture_output=True, text=True, check=True)
    return [json.loads(line) for line in found.stdout.splitlines()]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    add_arguments(parser)
    parser.add_argument("--package", help="folder of a package with visible sets")
    parser.add_argument("--eyes", type=int, default=6)
    parser.add_argument("--seed", type=int, default=3)
    args = parser.parse_args()
    need(args.package, "--package, that `gsvis prepare` makes")
    rng = np.random.default_rng(args.seed)
    with tempfile.TemporaryDirectory() as made_in, Package.open(args.package) as package:
        script = build_reader(Path(made_in), "trace")
        plain = build_reader(Path(made_in), "plain", LITTLE=1.0)
        static = write_static(Path(made_in) / "scene", package)
        views, cameras = views_of(package, args.eyes, rng)
        left, right, top, bottom = TANGENTS
        said = json.loads((static.path / "scene.json").read_bytes())["first"]
        firsts = [{"pose": {key: first[key] for key in ("position", "rotation")}} for first in said]
        views += [{**first, "view": {"left": left, "right": right, "up": top, "down": bottom}} for first in firsts]
        cameras += [camera_of(first["pose"]) for first in firsts]
        traces = trace(static.path, views, script)
        without = trace(static.path, views, plain)
        contents = package.contents
        ids = package_ids(package)
        scene, evaluator = StreamedScene.open(package), Evaluator(contents.colors().dequantize())
        rows, rows_seen = [], []
        for view, camera, static_steps, plain_steps in zip(views, cameras, traces, without, strict=True):
            rows_seen.append(view)
            name_arrivals(static_steps, ids, contents)
            name_arrivals(plain_steps, ids, contents)
            eye = Eye(contents, evaluator, camera)
            if not is_drawn(package, eye, view["pose"]):
                continue
            ours = first_bytes(eye, static_steps)
            theirs = first_bytes(eye, stream(scene, camera, view["pose"]))
            place = "eyes in cells" if len(rows_seen) <= args.eyes else "first views"
            bare = first_bytes(eye, plain_steps)
            row = {"place": place, "static": ours, "stream": theirs, "without glances": bare}
            rows.append({**row, "all": static_steps[-1]["bytes"]})
            print(f"{place}: static {ours}  stream {theirs}  without glances {bare}", flush=True)
    firsts = [steps[0]["bytes"] for steps in traces]
    figures: list[dict[str, Any]] = [
        {
            "name": f"bytes until the first block, {len(firsts)} eyes, median", "target": None,
            "reached": float(np.median(firsts)), "unit": "bytes", "better": "lower", "worst": max(firsts),
        }
    ]  # fmt: skip
    for place in ("first views", "eyes in cells"):
        for target in TARGETS:
            some = [row for row in rows if row["place"] == place]
            figures += ratios_of(some, place, target, "stream", "those of the server")
            if place == "eyes in cells":
                figures += ratios_of(some, place, target, "without glances", "those without glances")
    write_result(
        args.out, __doc__.splitlines()[0], figures, {"package": repr(package), "eyes": [spell(row) for row in rows]}
    )


def ratios_of(rows: list[dict[str, Any]], place: str, target: float, other: str, label: str) -> list[dict[str, Any]]:
    """The figures of one target at one kind of place: bytes of the site over those of something else."""
    found = [
        (r["static"][target][0], r[other][target][0]) for r in rows if target in r["static"] and target in r[other]
    ]
    if not found:
        return []
    pairs = np.array(found)
    ratios = pairs[:, 0] / pairs[:, 1]
    together = pairs[:, 0].sum() / pairs[:, 1].sum()
    name = f"{place}: bytes until {target:.0f} dB over {label}, {len(pairs)} eyes"
    goal = 1.3 if target == 35.0 and other == "stream" else None
    return [
        {
            "name": f"{name}, {how}", "target": goal, "reached": float(reached), "unit": "x", "better": "lower",
            "worst": float(ratios.max()),
        }
        for how, reached in (("median", np.median(ratios)), ("all bytes together", together))
    ]  # fmt: skip


def spell(row: dict[str, Any]) -> dict[str, Any]:
    return {
        key: value if key in ("all", "place") else {str(k): list(v) for k, v in value.items()}
        for key, value in row.items()
    }


def package_ids(package: Package) -> np.ndarray:
    """Id in the package of each id of its static form."""
    contents, g = package.contents, package.contents.gaussians()
    highest = np.flatnonzero(contents.last == len(contents.names) - 1)
    bright = Lights(package, g).brightest()[highest]
    parts = [highest[part] for part in divide_in_space(g.means[highest].astype(np.float64), bright)]
    return Placing.from_parts(parts, contents.chunks, len(contents)).order


def camera_of(pose: dict[str, Any], size: tuple[int, int] = SIZE, fov: float = 90.0) -> Cameras:
    """The camera of a pose, `fov` degrees wide."""
    eye = np.array(pose["position"])
    turn = rotations_from_quats(np.array([pose["rotation"]]))[0]
    return Cameras.look_at(eye[None], eye + turn[:, 2], up=-turn[:, 1], width=size[0], height=size[1], fov=fov)


def views_of(package: Package, count: int, rng: np.random.Generator) -> tuple[list[dict[str, Any]], list[Cameras]]:
    """Views from within cells that look level in random directions, and their cameras."""
    grid, up = package.visibility.grid, np.asarray(package.manifest.info.up)
    cells = rng.choice(len(grid), min(count, len(grid)), replace=False)
    views, cameras = [], []
    left, right, top, bottom = TANGENTS
    for cell in cells.tolist():
        eye = grid.centers[cell] + grid.cell_size * rng.uniform(-WITHIN, WITHIN, 3)
        ahead = np.cross(up, rng.normal(size=3))
        camera = Cameras.look_at(
            eye[None], eye + ahead / np.linalg.norm(ahead), up=up, width=SIZE[0], height=SIZE[1], fov=90.0
        )
        turn = camera.viewmats[0, :3, :3].T
        pose = {"position": eye.tolist(), "rotation": quats_from_rotations(turn[None])[0].tolist()}
        views.append({"pose": pose, "view": {"left": left, "right": right, "up": top, "down": bottom}})
        cameras.append(camera)
    return views, cameras


if __name__ == "__main__":
    main()
