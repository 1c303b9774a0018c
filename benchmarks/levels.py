"""How good are quality levels at a size, against everything else that makes a scene that small?

One scene a run, the full scene N Gaussians. At 18.7, 25, 34.9 and 50% of N: our level (folders written by `gsvis
levels`), the Gaussians of largest summed weight over the training cameras, an octree whose voxels are merged and not
trained (Octree-GS trains its anchors), both decimations of
splat-transform, and images with that share of the pixels (figure 4). Showroom is judged by 16 held-out eyes at standing
height against renders of the full scene, bonsai against every 8th photograph. Then what happens when the levels of two
sizes are drawn together (figure 5). Everything found is kept in `--cache`, so that a second run is quick.

Given: a scene, the sizes of its levels and their reuse: shares kept and reused are options of `gsvis levels`, not
    findings.
Measured: PSNR of held-out views for each way to make a scene that small; bytes of going up.
Defaults chosen on: showroom LOD 3 and bonsai, the scenes that are measured too, by other cameras.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import _rivals as rivals
import numpy as np
from _harness import add_arguments, write_result
from _level_views import Case, Numbers, bonsai, drawn, showroom, summed_weights
from numpy.typing import NDArray

from gsvis.io import load_scene
from gsvis.io.levels import load_levels
from gsvis.scene.content import scene_hash
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.levels import Levels

SHARES = (0.187, 0.25, 0.349, 0.5)
PAIRS = ((0.187, 0.349), (0.25, 0.5))
METHODS = ("ours", "weight", "octree", "decimate", "decimate-adaptive", "image")
SAID = {
    "ours": "our level",
    "weight": "largest summed weight",
    "octree": "octree, merged and not trained",
    "decimate": "splat-transform --decimate",
    "decimate-adaptive": "splat-transform --decimate-adaptive",
    "image": "image with that share of the pixels",
}
AHEAD = {"weight": 3.0, "octree": 0.0, "decimate": 0.0, "decimate-adaptive": 0.0}
"""dB by which our level should be ahead."""
WORST_AHEAD = "decimate"
"""Whose worst view ours should reach."""
FEWER, MORE = 0.01, 0.001  # of its size, by which a level of ours may miss it


@dataclass(frozen=True, eq=False)
class Rivals:
    """Scenes of any method and size, made when asked for.

    Attributes:
        case: The scene and its cameras.
        ours: Levels by their shares in words.
        cache: Where slow things stay.
    """

    case: Case
    ours: dict[str, Levels]
    cache: Path

    @cached_property
    def weights(self) -> NDArray[np.float64]:
        return summed_weights(self.case, self.cache)

    def count(self, share: float) -> int:
        return round(share * len(self.case.scene))

    def level(self, share: float) -> tuple[Levels, int] | None:
        """Our levels and which of them has that share, if any does."""
        for levels in self.ours.values():
            for k, count in enumerate(levels.counts):
                if (1.0 - FEWER) * self.count(share) <= count <= (1.0 + MORE) * self.count(share):
                    return levels, k
        return None

    def has(self, method: str, share: float) -> bool:
        return method != "ours" or self.level(share) is not None

    def scene(self, method: str, share: float) -> Gaussians:
        count = self.count(share)
        if method == "ours":
            found = self.level(share)
            assert found is not None
            return found[0].level(found[1])
        if method == "weight":
            return rivals.heaviest(self.case.scene, self.weights, count)
        if method == "octree":
            return rivals.octree(self.case.scene, count)
        return rivals.decimated(self.case.scene, count, method == "decimate-adaptive", self.cache)

    def together(self, method: str, low: float, high: float) -> Gaussians:
        """Two sizes drawn at once; what they share, if it is known to be shared, once."""
        if method == "ours":
            small, large = self.level(low), self.level(high)
            assert small is not None
            assert large is not None
            if small[0] is large[0]:
                return small[0].union[small[0].member(small[1]) | small[0].member(large[1])]
        return rivals.merged_densities(self.scene(method, low), self.scene(method, high))

    def images(self, method: str, share: float, views: Any = slice(None)) -> tuple[int, NDArray[np.float32]]:
        """Number of Gaussians and images."""
        if method == "image":
            return 0, rivals.downsampled_images(self.case.target[views], share)
        scene = self.scene(method, share)
        return len(scene), drawn(scene, self.case.held_out[views])

    def key(self, method: str, share: float) -> str:
        """Names what a method gives at a size; the rules of rivals are part of it."""
        if method == "ours":
            return f"scene-{scene_hash(self.scene(method, share))[:16]}"
        if method == "weight":
            return f"scene-{scene_hash(self.scene(method, share))[:16]}"
        rules = rivals.digest(np.frombuffer(Path(rivals.__file__).read_bytes(), np.uint8))[:8]
        parts = [scene_hash(self.case.scene)[:16], method, str(self.count(share))]
        return "-".join(parts if method in rivals.DECIMATIONS else [*parts, rules])


def compare(made: Rivals, numbers: Numbers, methods: Sequence[str], shares: Sequence[float]) -> list[dict[str, Any]]:
    """A row for each share and method."""
    rows = []
    for share in shares:
        for method in methods:
            if not made.has(method, share):
                print(f"{share:.1%}: no level of ours has this size", flush=True)
                continue
            row = {"share": share, "method": method}
            said = f"{share:.1%} {method}"
            row |= timed(said, numbers, made.key(method, share), lambda m=method, s=share: made.images(m, s))
            rows.append(row)
    return rows


def timed(
    said: str, numbers: Numbers, key: str, images: Callable[[], tuple[int, NDArray[np.float32]]]
) -> dict[str, Any]:
    """The numbers, printed, and the drift of brightness with them."""
    start = time.perf_counter()
    found = numbers.of(key, images)
    found["drift"] = found["brightness"] / numbers.brightness - 1.0
    print(
        f"{said:32} {found['count']:>9,} PSNR {found['psnr']:.2f} (worst {found['worst_psnr']:.2f}) "
        f"SSIM {found['ssim']:.4f} FLIP {found['flip']:.4f} brightness {found['drift']:+.2%}, "
        f"{time.perf_counter() - start:.0f} s",
        flush=True,
    )
    return found


def unions(
    made: Rivals, numbers: Numbers, methods: Sequence[str], rows: list[dict[str, Any]], merge: Path | None
) -> list[dict[str, Any]]:
    """Figure 5: two sizes drawn together, next to the larger alone; `merge` is a scene trained by itself."""
    alone = {(row["method"], row["share"]): row["psnr"] for row in rows}
    found = []
    for method in (m for m in methods if m not in ("image", "weight")):  # subsets by weight lie in each other
        for low, high in PAIRS:
            if (method, low) not in alone or (method, high) not in alone:
                continue

            def both(m: str = method, a: float = low, b: float = high) -> tuple[int, NDArray[np.float32]]:
                scene = made.together(m, a, b)
                return len(scene), drawn(scene, made.case.held_out)

            key = f"{made.key(method, low)}-with-{made.key(method, high)}"
            row = {"method": method, "low": low, "high": high, "low_psnr": alone[method, low]}
            found.append(
                row
                | {"high_psnr": alone[method, high]}
                | timed(f"{low:.1%} and {high:.1%} {method}", numbers, key, both)
            )
    if merge is not None:
        low_scene, full = load_scene(merge), made.case.scene
        each = {}
        for name, scene in (("low", low_scene), ("high", full), ("", rivals.merged_densities(low_scene, full))):
            key = f"scene-{scene_hash(scene)[:16]}"
            each[name] = timed(
                f"{name or 'both'} trained by itself",
                numbers,
                key,
                lambda s=scene: (len(s), drawn(s, made.case.held_out)),
            )
        row = {"method": "trained by itself", "low": len(low_scene) / len(full), "high": 1.0}
        row |= {"low_psnr": each["low"]["psnr"], "high_psnr": each["high"]["psnr"]}
        found.append(row | each[""])
    return found


def earlier(path: Path, made: Rivals, numbers: Numbers) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Rows of the rivals from an earlier result with the same scene and the same held-out images."""
    details = json.loads(path.read_text(encoding="utf-8"))["details"]
    same = {
        "gaussians": len(made.case.scene),
        "held_out_views": len(made.case.held_out),
        "target_brightness": numbers.brightness,
    }
    if any(details[name] != value for name, value in same.items()):
        raise SystemExit(f"--rivals-from: expected a result with {same}, got {[details[name] for name in same]}")
    found = [[row for row in details[name] if row["method"] != "ours"] for name in ("rows", "drawn_together")]
    return found[0], found[1]


def figures(made: Rivals, rows: list[dict[str, Any]], together: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """What the table of results shows."""
    name = made.case.name
    by = {(row["method"], row["share"]): row for row in rows}
    found: list[dict[str, Any]] = []

    def add(said: str, reached: float, unit: str, target: float | None = None, better: str = "higher") -> None:
        found.append({"name": f"{name}, {said}", "target": target, "reached": reached, "unit": unit, "better": better})

    for share in SHARES:
        ours = by.get(("ours", share))
        for method in METHODS:
            if (row := by.get((method, share))) is not None:
                add(f"{share:.1%} of the Gaussians, {SAID[method]}: PSNR", row["psnr"], "dB")
        for method in METHODS:
            if (row := by.get((method, share))) is not None:
                least = by.get((WORST_AHEAD, share)) if method == "ours" else None
                target = None if least is None else least["worst_psnr"]
                add(f"{share:.1%} of the Gaussians, {SAID[method]}: PSNR, worst view", row["worst_psnr"], "dB", target)
        for method, ahead in AHEAD.items():
            if ours is not None and (row := by.get((method, share))) is not None:
                add(f"{share:.1%}: our level over {SAID[method]}", ours["psnr"] - row["psnr"], "dB", ahead)
        if ours is not None:
            add(f"{share:.1%}: our level, brightness over that of the target", 1.0 + ours["drift"], "ratio")
    for sizes, levels in made.ours.items():
        for k, share in enumerate(levels.reuse):
            add(f"levels of {sizes}: reuse of {levels.names[k]} in {levels.names[k + 1]} (an input)", share, "share")
        add(
            f"levels of {sizes}: going up level by level over high at once, less one",
            levels.overhead,
            "share",
            0.05 if len(levels.names) == 3 else None,  # of more levels in one folder nobody goes up all
            "lower",
        )
    for row in together:
        said = f"{SAID.get(row['method'], row['method'])}, {row['low']:.1%} and {row['high']:.1%} drawn together"
        add(f"{said}: PSNR over that of the larger alone", row["psnr"] - row["high_psnr"], "dB")
    return found


def parse_arguments() -> argparse.Namespace:
    parser = add_arguments(argparse.ArgumentParser(description=__doc__))
    parser.add_argument("--scene", choices=("showroom", "bonsai"), default="showroom")
    parser.add_argument("--scene-file", type=Path, help="the trained bonsai, a PLY")
    parser.add_argument("--photos", type=Path, help="folder of the photographs of bonsai")
    parser.add_argument("--levels-dir", type=Path, nargs="+", default=[], help="folders written by gsvis levels")
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=list(METHODS))
    parser.add_argument("--shares", nargs="+", type=float, choices=SHARES, default=list(SHARES))
    parser.add_argument("--train-views", type=int, default=256, help="training cameras in showroom")
    parser.add_argument("--train-seed", type=int, default=7, help="theirs")
    parser.add_argument("--train-anywhere", action="store_true", help="draw them as gsvis levels does, not standing")
    parser.add_argument("--rivals-from", type=Path, help="take the rows of the rivals from this earlier result")
    parser.add_argument("--seconds", type=Path, help="JSON of the runs of gsvis levels: their times, kept as they are")
    parser.add_argument("--merge", type=Path, help="a sparser scene trained by itself, for figure 5")
    parser.add_argument("--cache", type=Path, default=Path(tempfile.gettempdir()) / "rivals", help="keeps what is slow")
    parser.add_argument("--pictures", type=Path, help="folder for a sheet of one held-out view")
    parser.add_argument("--view", type=int, default=0, help="which view the sheet shows")
    return parser.parse_args()


def main() -> None:
    arguments = parse_arguments()
    if arguments.scene == "bonsai" and arguments.scene_file is None:
        print("skipped: bonsai needs --scene-file, a PLY that gsvis train wrote")
        return
    arguments.cache.mkdir(parents=True, exist_ok=True)
    loaded = [load_levels(folder) for folder in arguments.levels_dir]
    case = (
        showroom(arguments.train_views, arguments.train_seed, arguments.train_anywhere)
        if arguments.scene == "showroom"
        else bonsai(arguments.scene_file, arguments.photos)
    )
    ours = {" and ".join(f"{n / len(case.scene):.1%}" for n in levels.counts[:-1]): levels for levels in loaded}
    made, numbers = Rivals(case, ours, arguments.cache), Numbers(case, arguments.cache)
    full = None
    if case.against != "the full scene":
        key = f"scene-{scene_hash(case.scene)[:16]}"
        full = timed("full", numbers, key, lambda: (len(case.scene), drawn(case.scene, case.held_out)))
    methods = [m for m in arguments.methods if m != "ours" or ours]
    if arguments.rivals_from is not None:
        methods = ["ours"]
    rows = compare(made, numbers, methods, arguments.shares)
    together = unions(made, numbers, methods, rows, arguments.merge)
    if arguments.rivals_from is not None:
        more, both = earlier(arguments.rivals_from, made, numbers)
        rows, together = rows + more, together + both
    if arguments.pictures:
        from _level_pictures import write_sheet

        write_sheet(arguments.pictures / f"levels_{case.name}.png", made, rows, methods, arguments.view)
    details = {
        "gaussians": len(case.scene),
        "training_views": len(case.train),
        "held_out_views": len(case.held_out),
        "against": case.against,
        "full": full,
        "target_brightness": numbers.brightness,
        "levels": {
            name: {"names": levels.names, "counts": levels.counts, "reuse": levels.reuse, "overhead": levels.overhead}
            for name, levels in ours.items()
        },
        "times": None if arguments.seconds is None else json.loads(arguments.seconds.read_text(encoding="utf-8")),
        "rivals_from": None if arguments.rivals_from is None else "an earlier run with the same held-out images",
        "rows": rows,
        "drawn_together": together,
    }
    question = "How good are quality levels at a size, against everything else that makes a scene that small?"
    write_result(arguments.out, question, figures(made, rows, together), details)


if __name__ == "__main__":
    main()
