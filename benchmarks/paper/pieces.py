"""What is each departure from the paper worth, piece by piece?

Prepares one scene in our way, then with one piece at a time in the paper's (`gsvis.cli.paper.PIECES`), then with all of
them; `--base paper` begins from the paper's system and exchanges one piece for ours. The pieces are the options of the
commands. What a piece does not change is taken from the first preparation. Quality is measured by cameras of another
seed, against the scene itself; sessions walk through the scene over constant links. With `--photos` photographs held
out are the truth, and there are no sessions: `benchmarks/arena/run.py` plays those.

    python benchmarks/paper/pieces.py                                  # builtin:two_rooms, no data
    python benchmarks/paper/pieces.py --scene nika/lod-meta.json --lod 2 --walks a.csv b.csv
    python benchmarks/paper/pieces.py --scene scene.ply --photos DIR --width 200 --height 133

Given: a scene, walks (drawn where none are given), constant links.
Measured: PSNR of all levels in held-out views, with all records and with what a cell needs; bytes of the package;
    seconds of processor of what a piece changes; PSNR and QoE (equation 8) of sessions, as differences with Student's
    95% interval over walks and links.
Defaults chosen on: nothing here; those of gsvis on other scenes and seeds, as their own benchmarks say.
"""

from __future__ import annotations

import argparse
import shutil
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from _harness import add_arguments, write_result

from gsvis.abr import AbrConfig, BandwidthTrace
from gsvis.abr.qoe import paired_difference
from gsvis.cli import parse
from gsvis.cli.arguments import Prepare, Serve
from gsvis.cli.options import leaves
from gsvis.cli.paper import Piece, pieces_of
from gsvis.cli.prepare import check_arguments
from gsvis.color.evaluate import Evaluator
from gsvis.errors import GsvisError
from gsvis.files.temporary import temporary_folder
from gsvis.io.poses import load_path
from gsvis.io.sources import load_source
from gsvis.package import Package, measure_fidelity
from gsvis.prepare import PrepareConfig, Prepared, prepare_package
from gsvis.prepare.warm import warm_colors, warm_levels, warm_sets
from gsvis.render import psnr, rasterize
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians, quats_from_rotations
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.paths import HeadPath
from gsvis.scene.place import find_place
from gsvis.scene.retarget import RetargetConfig, retarget
from gsvis.scene.view_sampling import ViewSampling
from gsvis.simulate import Adaptive, Link, Stage, ViewingConfig, play, watch
from gsvis.stream import StreamedScene
from paper.photographs import Photographs, add_options

JUDGES = ViewSampling(16, 320, 240, 70.0, seed=91, stream=11)
"""Cameras that nothing was made or chosen with."""
ROUND_TRIP = 0.04
CHANGED = ("low", "records", "cell", "worst")
MADE = {
    "levels": ("views", "photos", "prune", "train"),
    "sets": ("viewpoints", "cells", "check", "store"),
    "colors": ("directions", "importance", "price", "fit", "learn"),
    "epsilon": ("epsilon",),
    "terms": ("terms",),
}
"""What `prepare` reports while it makes something, by its stage; what it measures does not count."""


class System(NamedTuple):
    """One way to prepare and to send: its name, and the options that differ from ours."""

    name: str
    prepare: tuple[str, ...]
    serve: tuple[str, ...]


class Clock:
    """A progress callback that adds up the seconds of processor of each stage of a preparation."""

    def __init__(self) -> None:
        self.seconds = dict.fromkeys(MADE, 0.0)
        self._stage = ""
        self._since = time.process_time()

    def __call__(self, stage: str, done: int, total: int) -> None:
        """Take the time since the last call for the stage that was at work then."""
        now = time.process_time()
        word = self._stage.partition(" ")[0]
        for name, reported in MADE.items():
            if word in reported:
                self.seconds[name] += now - self._since
        self._stage, self._since = stage, now


@dataclass(frozen=True)
class Scene:
    """The scene, where eyes may be, the cameras that judge, and the walks.

    With photographs, those held out judge and are the truth; else cameras of another seed and the scene's own images.
    """

    name: str
    gaussians: Gaussians
    space: NavigableSpace
    judges: Cameras
    truth: tuple[np.ndarray, ...]
    walks: tuple[HeadPath, ...]
    photographs: Photographs | None = None

    @property
    def photos(self) -> Path | None:
        """Folder of the photographs; None without."""
        return None if self.photographs is None else self.photographs.folder


def main() -> None:
    parser = add_arguments(argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter))
    parser.add_argument("--scene", default="builtin:two_rooms")
    parser.add_argument("--lod", type=int)
    parser.add_argument("--base", choices=("ours", "paper"), default="ours", help="where each row begins")
    parser.add_argument("--pieces", nargs="*", help="options of these pieces alone, without --; default all")
    parser.add_argument("--prepare", nargs="*", default=[], metavar="NAME=VALUE", help="options of all preparations")
    parser.add_argument("--walks", nargs="*", type=Path, default=[], help="recorded walks; default two that are drawn")
    add_options(parser)
    parser.add_argument("--mbit", nargs="*", type=float, default=[1.0, 3.0], help="constant links")
    parser.add_argument("--seconds", type=float, default=15.0, help="of a session")
    options = parser.parse_args()
    try:
        measure_all(options)
    except (GsvisError, ValueError, OSError) as error:
        raise SystemExit(f"error: {error}") from None


def measure_all(options: argparse.Namespace) -> None:
    """Measure all systems, print the table and write the result."""
    photographs = Photographs.read(options)
    scene = open_scene(options.scene, options.lod, options.walks, options.seconds, photographs)
    common = [word for each in options.prepare for word in ("--" + each).split("=")]
    common += [] if photographs is None else photographs.words
    with temporary_folder() as work:
        rows, failed = measure_systems(scene, systems_of(options.base, options.pieces), common, options, Path(work))
    print(table(rows))
    details = {"scene": scene.name, "gaussians": len(scene.gaussians), "base": options.base, "rows": rows}
    details["failed"] = failed
    details["judges"] = vars(JUDGES) if photographs is None else f"{len(scene.judges)} photographs held out"
    details |= {"walks": [len(walk) for walk in scene.walks], "links_mbit": options.mbit}
    write_result(options.out, "What is each departure from the paper worth?", figures_of(rows), details)


def systems_of(base: str, only: list[str] | None) -> list[System]:
    """Return the base, the base with one piece exchanged at a time, and the other whole system."""
    known = {name: pieces_of([leaf.option for leaf in leaves(type(parse(words)))]) for name, words in _EMPTY.items()}
    every = list({piece.option: piece for found in known.values() for piece in found}.values())
    chosen = [piece for piece in every if only is None or piece.option[2:] in only]

    def system(name: str, pieces: list[Piece]) -> System:
        """Return the system with some pieces in the paper's way."""
        words = [[word for piece in found if piece in pieces for word in piece.words] for found in known.values()]
        return System(name, tuple(words[0]), tuple(words[1]))

    ours, paper = system("ours", []), system("the paper's", every)
    if base == "ours":
        return [ours, *(system(" ".join(piece.words)[2:], [piece]) for piece in chosen), paper]
    singles = [system(f"{piece.option[2:]} {piece.ours}", [p for p in every if p != piece]) for piece in chosen]
    return [paper, *singles, ours]


_EMPTY = {"prepare": ["prepare", "a.ply", "-o", "b"], "serve": ["serve", "a"]}


def measure_systems(
    scene: Scene, systems: list[System], common: list[str], options: argparse.Namespace, work: Path
) -> tuple[list[dict[str, Any]], dict[str, str]]:
    """Return one row for each system, and why others failed; systems that are prepared alike share a package."""
    made: dict[str, tuple[Path, dict[str, float]]] = {}
    failed: dict[str, str] = {}
    rows: list[dict[str, Any]] = []
    base: tuple[Path, dict[str, float]] | None = None
    for number, system in enumerate(systems):
        config = config_of(options, common, system)
        key = repr(config)
        if key not in made:
            out = work / f"{number}.gsvis"
            if base is None:
                warm(config)
            else:
                shutil.copytree(base[0].with_name(f"{base[0].name}.work"), out.with_name(f"{out.name}.work"))
            begun = time.perf_counter()
            try:
                made[key] = out, prepare(scene, out, config, {} if base is None else base[1])
            except (GsvisError, ValueError) as error:
                print(f"{system.name}: cannot be prepared: {error}", file=sys.stderr, flush=True)
                failed[system.name] = str(error)
                continue
            print(f"{system.name}: prepared in {time.perf_counter() - begun:.0f} s", file=sys.stderr, flush=True)
        out, seconds = made[key]
        base = base or (out, seconds)
        rows.append({"name": system.name, "seconds": seconds, **measure(scene, out, system, options)})
        print(f"{system.name}: measured", file=sys.stderr, flush=True)
    for row in rows:
        row["against"] = compare(row, rows[0])
    return rows, failed


def config_of(options: argparse.Namespace, common: list[str], system: System) -> PrepareConfig:
    """Return the settings that the command line of a system gives."""
    lod = [] if options.lod is None else ["--lod", str(options.lod)]
    words = ["prepare", options.scene, "-o", "out.gsvis", *lod, *common, *system.prepare]
    command = parse(words)
    assert isinstance(command, Prepare)
    return check_arguments(command)


def warm(config: PrepareConfig) -> None:
    """Load all kernels, so that they count for nobody."""
    silent = Quiet()
    warm_sets(config.sets, silent)
    warm_colors(config.colors, silent)
    if config.levels is not None:
        warm_levels(config.levels, silent)


class Quiet:
    """A progress callback that says nothing."""

    def __call__(self, stage: str, done: int, total: int) -> None:
        """Do nothing."""


def prepare(scene: Scene, out: Path, config: PrepareConfig, known: dict[str, float]) -> dict[str, float]:
    """Prepare a package; return the seconds of processor of its stages, those of kept results from `known`."""
    clock = Clock()
    made: Prepared = prepare_package(scene.gaussians, out, scene.space, config, photos=scene.photos, progress=clock)
    return {
        stage.name: known[stage.name] if stage.reused and stage.name in known else clock.seconds[stage.name]
        for stage in made.stages
        if stage.name in MADE
    }


def measure(scene: Scene, out: Path, system: System, options: argparse.Namespace) -> dict[str, Any]:
    """Return quality, bytes and sessions of a package that is sent in the way of a system."""
    with Package.open(out) as package:
        levels = level_psnr(package, scene)
        quality = against_scene(package, scene) if scene.photographs is None else against_photographs(package, scene)
        visible = float(np.mean(package.visibility.visible_counts)) / len(package)
        sizes = {**package.manifest.sizes(), "epsilon": package.epsilon, "terms_count": package.manifest.terms}
        return {
            "levels": levels,
            "low": levels["low"],
            **quality,
            "sizes": sizes,
            "bytes": sum(part.nbytes for part in package.manifest.parts()),
            "cell_sees": visible,
            "sessions": [] if scene.photographs else sessions(scene, package, system, options),
        }


def against_scene(package: Package, scene: Scene) -> dict[str, float | None]:
    """Return the PSNR of all records and of what a cell needs, against the scene, and the worst view of the latter."""
    found = measure_fidelity(
        scene.gaussians,
        package.contents,
        scene.judges,
        sets=package.visibility,
        active=package.active_terms,
    )
    assert found.cell is not None
    return {"records": found.records.psnr, "cell": found.cell.psnr, "worst": found.cell.worst}


def against_photographs(package: Package, scene: Scene) -> dict[str, float | None]:
    """Return the same against photographs; what a cell needs is judged against the scene alone, and None here."""
    values = view_psnr(package, scene, len(package.contents.names) - 1)
    return {"records": float(np.mean(values)), "cell": None, "worst": min(values)}


def level_psnr(package: Package, scene: Scene) -> dict[str, float]:
    """Return the mean PSNR of each level below the highest."""
    names = package.contents.names[:-1]
    return {name: float(np.mean(view_psnr(package, scene, level))) for level, name in enumerate(names)}


def view_psnr(package: Package, scene: Scene, level: int) -> list[float]:
    """Return the PSNR of a level in each view of the judges, as a client shows it with all its terms."""
    contents = package.contents
    g = contents.gaussians()
    colors = Evaluator(contents.colors().dequantize())
    held = (contents.first <= level) & (level <= contents.last)
    values = []
    for c, truth in enumerate(scene.truth):
        camera = scene.judges[c]
        shown = rasterize(g[held], camera, colors=colors.colors(g.means, camera.viewpoints[0])[held]).images[0]
        values.append(min(100.0, float(psnr(np.clip(shown, 0.0, 1.0), truth))))
    return values


def sessions(scene: Scene, package: Package, system: System, options: argparse.Namespace) -> list[dict[str, Any]]:
    """Return the figures of a session for each walk and link; walks that see nothing of the scene have none."""
    command = parse(["serve", "a", *system.serve])
    assert isinstance(command, Serve)
    sending = command.sending
    streamed = StreamedScene.open(package).sending(sending.terms)
    stage = Stage(streamed.contents, scene.gaussians)
    config = ViewingConfig(seconds=options.seconds, every=1.0, fine=2.0)
    rows = []
    for walk in scene.walks:
        played = [
            play(
                Adaptive(streamed, config.view, AbrConfig(policy=sending.policy)),
                Link(BandwidthTrace.constant(rate), ROUND_TRIP),
                walk,
                stage.size,
                seconds=config.watched,
                tick=config.tick,
            )
            for rate in options.mbit
        ]
        rows += [seen.figures() for seen in watch(stage, played, walk, config)]
    return [row for row in rows if row["score"] is not None]


def compare(row: dict[str, Any], base: dict[str, Any]) -> dict[str, Any]:
    """Return the differences of a row from the first."""
    measured = [name for name in CHANGED if row[name] is not None]
    apart: dict[str, Any] = {name: row[name] - base[name] for name in measured}
    apart["bytes"] = row["bytes"] / base["bytes"] - 1.0
    apart["seconds"] = sum(row["seconds"].values()) - sum(base["seconds"].values())
    for name in ("score", "psnr"):
        mine, theirs = ([each[name] for each in one["sessions"]] for one in (row, base))
        apart[f"session_{name}"] = paired_difference(mine, theirs).as_dict() if len(mine) == len(theirs) > 1 else None
    return apart


def table(rows: list[dict[str, Any]]) -> str:
    """Return the rows as a table in Markdown."""
    head = ["", "low level, dB", "all records, dB", "what a cell needs, dB", "worst view", "MB", "processor, s"]
    head += ["session, dB", "QoE, 95%"]
    lines = [f"| {' | '.join(head)} |", f"|{'---|' * len(head)}"]
    for row in rows:
        score, db = row["against"]["session_score"], row["against"]["session_psnr"]
        said = ("-" if row[name] is None else f"{row[name]:.2f}" for name in CHANGED)
        cells = [row["name"], *said, f"{row['bytes'] / 1e6:.3f}", f"{sum(row['seconds'].values()):.1f}"]
        if not row["sessions"]:
            cells += ["-", "-"]
        elif row is rows[0] or score is None:
            cells += [f"{np.mean([each[name] for each in row['sessions']]):.2f}" for name in ("psnr", "score")]
        else:
            cells += [f"{db['mean']:+.2f}", f"{score['mean']:+.3f} ({score['low']:.3f} to {score['high']:.3f})"]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def figures_of(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the figures of the result: differences from the first row."""
    said = {"records": ("all records", "dB", "higher"), "cell": ("what a cell needs", "dB", "higher")}
    said |= {"low": ("low level", "dB", "higher"), "bytes": ("bytes, share more", "", "lower")}
    said["seconds"] = ("processor more", "s", "lower")
    return [
        {"name": f"{row['name']}: {text}", "target": None, "reached": row["against"][key], "unit": unit, "better": good}
        for row in rows[1:]
        for key, (text, unit, good) in said.items()
        if key in row["against"]
    ]


def open_scene(
    path: str, lod: int | None, walks: list[Path], seconds: float, photographs: Photographs | None = None
) -> Scene:
    """Return the scene with its judges and walks.

    Raises:
        SystemExit: If there is no place for eyes.
    """
    source = load_source(path, lod)
    g = source.gaussians
    place = find_place(source, cameras=None if photographs is None else photographs.cameras)
    if place.space is None:
        raise SystemExit(f"{path}: {place.why_not}; take another scene")
    if photographs is None:
        judges = JUDGES.cameras(g, place.space)
        truth = tuple(np.clip(rasterize(g, judges[c]).images[0], 0.0, 1.0) for c in range(len(judges)))
    else:
        judges = photographs.judges
        truth = photographs.truth
    given = [load_path(walk).cut(0.0, seconds + 2.0) for walk in walks] or [
        drawn_walk(seed, seconds) for seed in (1, 2)
    ]
    moved = [
        retarget(walk, place.space, RetargetConfig(project=True, seed=90 + k)).path for k, walk in enumerate(given)
    ]
    return Scene(source.name, g, place.space, judges, truth, tuple(moved), photographs)


def drawn_walk(seed: int, seconds: float) -> HeadPath:
    """Return a walk of somebody who wanders through some meters and looks around; z is up."""
    rng = np.random.default_rng([seed, 17])
    times = np.arange(0.0, seconds + 2.0, 0.1)
    waves = rng.uniform(0.1, 0.35, (3, 2))
    phases = rng.uniform(0.0, 2.0 * np.pi, (3, 2))
    x, y, turn = (np.sin(waves[k, :1] * times + phases[k, :1]) for k in range(3))
    positions = np.stack([1.5 * x, 1.5 * y, np.full_like(times, 1.6)], axis=1)
    angles = phases[2, 1] + 2.0 * turn + 0.3 * times
    ahead = np.stack([np.cos(angles), np.sin(angles), np.zeros_like(times)], axis=1)
    up = np.array([0.0, 0.0, 1.0])
    right = np.cross(ahead, up)
    rotations = np.stack([right, np.tile(-up, (len(times), 1)), ahead], axis=2)
    return HeadPath(times, positions, quats_from_rotations(rotations), up)


if __name__ == "__main__":
    main()
