"""What do the figures and tables of the paper look like on a scene of yours, or on one that is built in?

    python benchmarks/paper/figures.py                                   # builtin:two_rooms, in minutes, no data
    python benchmarks/paper/figures.py --scene scene.ply --figures 3 13  # some figures of a scene of yours
    python benchmarks/paper/figures.py --scene scene.ply --photos DIR --width 200 --height 133   # judged by photographs

Writes PNG files with the paper's points drawn in where it states any, tables.md from this run, and captions.md, which
says what could not be made like for like. Everything comes from this run, nothing from kept results.

Given: a scene, walks that are drawn, a constant link.
Measured: what each figure shows, in views that nothing was fitted or chosen with.
Defaults chosen on: nothing here.
"""

from __future__ import annotations

import argparse
import io
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from _harness import write_result
from _lightness import FUNCTIONS, even_directions, unit_variance

from gsvis.errors import GsvisError
from gsvis.files.temporary import temporary_folder
from gsvis.raycast import FACE_LIMITS, PAPER
from gsvis.render import psnr, rasterize
from gsvis.report.theme import LIGHT
from gsvis.scene.cameras import Cameras
from gsvis.scene.icosphere import face_directions, face_shares
from gsvis.simulate.viewing import Viewing
from gsvis.train import most_important
from paper.highlights import find_highlight
from paper.photographs import Photographs, add_options
from paper.pieces import open_scene
from paper.sphere import SphereConfig, fit_function
from paper.spheres import sphere_figure
from paper.study import Likeness, Study, clipped
from paper.tables import details_of, figures_of, tables
from paper.walk import PAPER_WALK
from paper.walk_terms import PAPER_TERMS

F32 = NDArray[np.float32]

COUNTS = (2, 6, 10, 15, 20, 30)
ERRORS = (0.58533, 0.12596, 0.035824, 0.0083, 0.00302, 0.00074)
"""Figure 15: mean squared errors by the number of SRBFs."""
_PANEL = 3.3  # inches across an image
_LINE = 0.18  # inches of a line of a title
DROPS = {"middle": (0.011, -0.105), "low": (-3.635, -0.844)}
"""Figure 18: PSNR against that of the best level, in its two scenes."""
USUAL = ("cells=8", "steps=60", "face-size=256")
VIEWS = "views=60"
QUESTION = "What do colors in pieces cost, as tables 2 and 3 of the paper ask?"
NOT_HERE = """Figures 1, 2, 6 and 7 explain, they measure nothing. The four rivals of table 1 and Octree-GS are trained
from photographs, so they have no curve here: `benchmarks/arena/run.py` trains copies of them."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--scene", default="builtin:two_rooms")
    parser.add_argument("--lod", type=int)
    parser.add_argument("--figures", type=int, nargs="*", choices=FIGURES, default=list(FIGURES), help="default all")
    parser.add_argument("--no-tables", action="store_true")
    add_options(parser)
    usual = " ".join((*USUAL, VIEWS))
    parser.add_argument(
        "--prepare",
        nargs="*",
        metavar="NAME=VALUE",
        help=f"options of gsvis prepare; {usual}, without views by --photos",
    )
    parser.add_argument("--mbit", type=float, default=1.5, help="of the link")
    parser.add_argument("--seconds", type=float, default=12.0, help="of a session; the paper's have 30")
    parser.add_argument("--out", type=Path, default=Path("out/paper_figures"), help="folder of the PNG files")
    parser.add_argument("--result", type=Path, help="file for what the tables hold, as JSON")
    options = parser.parse_args()
    try:
        write_all(options)
    except (GsvisError, ValueError, OSError) as error:
        raise SystemExit(f"error: {error}") from None


def write_all(options: argparse.Namespace) -> None:
    """Write the figures and tables that were asked for, one by one."""
    photographs = Photographs.read(options)
    scene = open_scene(options.scene, options.lod, [], max(options.seconds, PAPER_WALK["seconds"]), photographs)
    words = words_of(options.prepare, photographs)
    options.out.mkdir(parents=True, exist_ok=True)
    captions = [f"# Figures of SRBF-Gaussian on {scene.name}", "", NOT_HERE]
    with temporary_folder() as work:
        study = Study(scene, Path(work), words, options.mbit, options.seconds)
        for number in options.figures:
            image, caption = FIGURES[number](study)
            path = options.out / f"figure_{number:02d}.png"
            path.write_bytes(image)
            captions += ["", f"**Figure {number}** ({path.name}). {caption}"]
            print(f"{path}: {caption}", flush=True)
        (options.out / "captions.md").write_text("\n".join([*captions, ""]), encoding="utf-8")
        if not options.no_tables:
            text = tables(study)
            (options.out / "tables.md").write_text(text, encoding="utf-8")
            print(text)
            if options.result is not None:
                write_result(options.result, QUESTION, figures_of(study), details_of(study))
        if "package" in vars(study):
            study.package.close()


def words_of(given: list[str] | None, photographs: Photographs | None) -> list[str]:
    """Return the options of `gsvis prepare`: those given, or few of all, and the photographs."""
    usual = [*USUAL, *([VIEWS] if photographs is None else [])]
    words = [word for each in (usual if given is None else given) for word in ("--" + each).split("=")]
    return words if photographs is None else [*words, *photographs.words]


Drawn = tuple[bytes, str]


def draw_directions(study: Study) -> Drawn:
    """Figure 3: from how many directions Gaussians are visible."""
    curves = {
        f"here, in {study.directions_views} views": (study.directions, LIGHT.gathered),
        "here, by rays outward": (study.traced, LIGHT.traced),
    }
    figure, axes = one_panel("share of the 80 directions", "share of the Gaussians seen from at most as many")
    for name, (cdf, color) in curves.items():
        axes.plot(np.arange(81) / 80.0, cdf.values, color=color, linewidth=2.2, label=name)
    points = [k / 80.0 for k in FACE_LIMITS], [PAPER["below_33_faces"], PAPER["below_48_faces"]]
    axes.plot(*points, "o", color=LIGHT.published, label="paper, Tanks & Temples")
    axes.legend(frameon=False, loc="lower right")
    said = [
        f"{name}: {', '.join(f'{cdf.below(k):.1%} below {k / 80:.2%}' for k in FACE_LIMITS)}"
        for name, (cdf, _) in curves.items()
    ]
    return png(figure), (
        f"{'; '.join(said)} of the directions; paper 39.4% and 80.4%. More views find more, and the paper does"
        " not say how many it had. Rays outward find all directions that lead to where eyes may be."
    )


def draw_reduction(study: Study) -> Drawn:
    """Figure 4: fewer pixels of an image, and fewer Gaussians of a scene."""
    camera = study.scene.judges[0]
    truth = study.draw_scene(camera)
    low = study.level(study.low)[1]
    g = study.scene.gaussians
    bare = most_important(g, study.gathered.importance, round(0.23 * len(g)))
    fewer = study_image(study, bare, camera)
    side = [max(1, round(n * np.sqrt(0.147))) for n in (camera.width, camera.height)]
    small = Image.fromarray((255.0 * truth).astype(np.uint8)).resize(side, Image.Resampling.BOX)
    large = np.asarray(small.resize((camera.width, camera.height), Image.Resampling.BICUBIC), np.float32) / 255.0
    named = {
        "14.7% of the pixels": large,
        "23% of the Gaussians": fewer,
        "ours, low level": study.draw_level(camera, low),
    }
    values = {name: float(psnr(image, truth)) for name, image in named.items()}
    said = ", ".join(f"{name} {value:.1f} dB" for name, value in values.items())
    return montage([[truth, *named.values()]], ["the scene", *(f"{n}, {v:.1f} dB" for n, v in values.items())]), (
        f"{said}. Paper, bicycle: 22.55 dB for the pixels, 14.78 for Octree-GS. The 23% here are those of the largest"
        " squared weights in views, not an octree's, and nothing is trained."
    )


def draw_together(study: Study) -> Drawn:
    """Figure 5: two levels that are drawn together."""
    camera = study.scene.judges[0]
    truth = study.draw_scene(camera)
    _, low = study.level(study.low)
    _, high = study.level(-1)
    images = [study.draw_level(camera, held) for held in (low, high, low | high)]
    names = ["low level", "highest level", "both together"]
    values = [float(psnr(image, truth)) for image in images]
    titles = ["the scene", *(f"{name}, {value:.1f} dB" for name, value in zip(names, values, strict=True))]
    return montage([[truth, *images]], titles), (
        f"{', '.join(titles[1:])}. What only the low level has stands for Gaussians that the highest has too, so"
        " both together are worse than the highest alone; a client drops it when its replacements arrive."
    )


def draw_spheres(study: Study) -> Drawn:
    """Figures 8 and 15: a function on the sphere by more and more SRBFs."""
    function = unit_variance(FUNCTIONS["three lamps"] if "three lamps" in FUNCTIONS else next(iter(FUNCTIONS.values())))
    directions = face_directions(16).reshape(-1, 3)
    config = SphereConfig(searches=1, sweeps=1)
    shares = face_shares(16).ravel()
    fit = fit_function(function(directions), directions, max_terms=max(COUNTS), weights=shares, config=config)
    others = even_directions(20_000)
    truth = function(others)
    errors = [float(np.mean((fit.evaluate(others, k) - truth) ** 2)) for k in COUNTS]
    rows = ", ".join(f"{k}: {mine:.4f} ({paper:.4f})" for k, mine, paper in zip(COUNTS, errors, ERRORS, strict=True))
    return sphere_figure(function, fit, errors=errors, counts=COUNTS), (
        f"Mean squared error by number of SRBFs, the paper's in brackets: {rows}. The paper does not name its function;"
        " this one has three soft lamps and unit variance. The lobes are moved after each choice. Errors are those"
        " between the directions of the fit, so they need not fall."
    )


def draw_sessions(study: Study) -> Drawn:
    """Figures 9 to 12 and 14: sessions over time."""
    panels = {
        "QoE of a step (figure 9)": "score",
        "PSNR, dB (figure 10)": "psnr",
        "latency, s (figure 11)": "latency",
        "Mbit/s received (figures 12 and 14)": "rate",
    }
    figure = Figure(figsize=(11.0, 7.4), dpi=110, layout="constrained")
    for (label, quantity), axes in zip(panels.items(), figure.subplots(2, 2).flat, strict=True):
        for number, (name, seen) in enumerate(study.sessions.items()):
            curves = [curve_of(each, quantity) for each in seen]
            mean = np.mean([values for _, values in curves], axis=0)
            axes.plot(curves[0][0], mean, linestyle=("-", "-", "-", "--")[number % 4], linewidth=1.8, label=name)
        if quantity == "rate":
            axes.axhline(study.mbit, color=LIGHT.muted, linestyle=":")
            axes.text(study.seconds, study.mbit, "link", ha="right", va="bottom", fontsize=8, color=LIGHT.muted)
        if quantity == "psnr":
            axes.axvspan(4.0, 5.0, color=LIGHT.published, alpha=0.15)
            axes.text(
                4.5, 1.0, "SOGG and Compressed-3D begin (paper)", rotation=90, ha="center", va="bottom", fontsize=8
            )
        style(axes, "seconds", label)
    figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=4, frameon=False)
    said = []
    for name, seen in study.sessions.items():
        score, db = (np.mean([getattr(each.qoe, key) for each in seen]) for key in ("score", "psnr"))
        said.append(f"{name} {score:+.2f}, {db:.1f} dB")
    return png(figure), (
        f"Mean QoE of a step and PSNR over {len(study.scene.walks)} walks of {study.seconds:g} s on a link of"
        f" {study.mbit:g} Mbit/s: {'; '.join(said)}. The paper's rivals are trained and not here; its curves have no"
        " numbers to draw. A whole file counts as the exact scene when it is there, which our records are not."
    )


def draw_walk(study: Study) -> Drawn:
    """Figure 13: what a walk needs of the Gaussians and of the SRBFs."""
    walked = study.walk_terms
    figure, axes = one_panel("seconds of walking", "share needed so far")
    axes.plot(walked.times, walked.gaussians, color=LIGHT.gathered, linewidth=2.2, label="Gaussians")
    axes.plot(walked.times, walked.terms, color=LIGHT.traced, linewidth=2.2, label="SRBFs")
    end = PAPER_WALK["seconds"]
    axes.plot([end], [PAPER_WALK["seen"]], "o", color=LIGHT.gathered, label="Gaussians, paper")
    axes.plot([0.0, end], [PAPER_TERMS["start"], PAPER_TERMS["end"]], "o", color=LIGHT.traced, label="SRBFs, paper")
    axes.set_ylim(0.0, 1.0)
    axes.legend(frameon=False, loc="upper left")
    return png(figure), (
        f"After {walked.times[-1]:.0f} s: {walked.gaussians[-1]:.1%} of the Gaussians and {walked.terms[-1]:.1%} of the"
        f" SRBFs ({walked.terms[0]:.1%} at the start); paper 86.85%, 22.39% and 3.58%. Seen by cameras on the walk,"
        f" active at the eye, epsilon {walked.epsilon:g}."
    )


def draw_colors(study: Study) -> Drawn:
    """Figure 16: images with SH and with SRBFs."""
    rows = []
    for c in (1, 2):
        camera = study.scene.judges[c]
        rows.append([study.draw_scene(camera), study.draw_variant("hsl", camera), study.draw_variant("ours", camera)])
    values = {name: study.variant_likeness(name).psnr for name in ("hsl", "ours")}
    said = f"{values['hsl']:.1f} dB in the paper's way, {values['ours']:.1f} dB in ours, with as many terms."
    if study.by_photographs:
        sh = study.scene_likeness.psnr
        caption = f"Against photographs that no training saw: {sh:.1f} dB with SH, {said}"
    else:
        caption = f"Against SH: {said} The paper compares with photographs."
    return montage(rows, ["SH", "HSL by OMP, the paper's", "RGB lobes, ours"]), caption


def draw_highlights(study: Study) -> Drawn:
    """Figure 17: the same place from different angles."""
    photographs = study.scene.photographs
    eyes = None if photographs is None else photographs.cameras.viewpoints
    found = find_highlight(study.scene.gaussians, study.scene.space, study.gathered.importance, eyes)
    cameras = found.cameras(320, 240)
    ways: dict[str, Callable[[Cameras], F32]] = {
        "SH": study.draw_scene,
        "HSL by OMP, the paper's": lambda camera: study.draw_variant("hsl", camera),
        "RGB lobes, ours": lambda camera: study.draw_variant("ours", camera),
    }
    shown = [[draw(cameras[c]) for c in range(len(cameras))] for draw in ways.values()]
    titles = ["from one eye", *(f"from another, {angle:.0f}° apart" for angle in found.angles[1:])]
    return montage(shown, titles, list(ways)), (
        "In the middle of each image is the place whose color changes most between two eyes, of those that views show"
        " most. The paper shows the sun on a desktop; a built-in scene has none, so take one of yours."
    )


def draw_levels(study: Study) -> Drawn:
    """Figure 18: the quality of the levels."""
    names = study.package.manifest.names
    camera = study.scene.judges[3]
    images, titles, drops = [], [], []
    best = study.level(-1)[1]
    for k, name in enumerate(names):
        _, held = study.level(k)
        images.append(study.draw_level(camera, held))
        found = study.compare(lambda camera, held=held: study.draw_level(camera, held))
        drops.append(found.psnr)
        share, stays = held.sum() / best.sum(), (held & best).sum() / held.sum()
        reused = "the best level" if np.array_equal(held, best) else f"{stays:.1%} reused by the best"
        titles.append(f"{name}: {int(held.sum()):,}, {share:.1%}\n{reused}\n{said_of(found)}")
    apart = ", ".join(f"{name} {value - drops[-1]:+.2f} dB" for name, value in zip(names[:-1], drops, strict=False))
    return montage([images], titles), (
        f"PSNR against that of the best level, mean of {len(study.scene.judges)} views: {apart}; paper, two scenes: low"
        f" {DROPS['low'][0]:+.2f} and {DROPS['low'][1]:+.2f}, middle {DROPS['middle'][0]:+.2f} and"
        f" {DROPS['middle'][1]:+.2f}, of 18.7 and 34.9% of the Gaussians. {levels_apart(study)}"
    )


def said_of(found: Likeness) -> str:
    """Return what was measured of an image in a line."""
    lpips = "" if found.lpips is None else f", LPIPS {found.lpips:.3f}"
    return f"{found.psnr:.1f} dB, SSIM {found.ssim:.3f}{lpips}"


def levels_apart(study: Study) -> str:
    """Return what is not like the paper in the comparison of levels."""
    if study.by_photographs:
        return "Against photographs that no training saw, as in the paper, but smaller ones and of another scene."
    return (
        "The paper compares with photographs, this run with the scene itself, so that the best level has no error but"
        " rounding and colors."
    )


FIGURES: dict[int, Callable[[Study], Drawn]] = {
    3: draw_directions,
    4: draw_reduction,
    5: draw_together,
    9: draw_sessions,
    13: draw_walk,
    15: draw_spheres,
    16: draw_colors,
    17: draw_highlights,
    18: draw_levels,
}
"""All figures with a measurement; 8 is a part of 15, and 10, 11, 12 and 14 are panels of 9."""


def curve_of(seen: Viewing, quantity: str) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return times and values of a quantity of a session."""
    if quantity != "rate":
        return seen.times, np.asarray(getattr(seen, quantity))
    borders = np.arange(0.0, seen.config.seconds + 0.25, 0.5)
    return borders[1:], np.asarray(8e-6 * np.diff(seen.playback.bytes_at(borders)) / 0.5)


def study_image(study: Study, held: NDArray[np.bool_], camera: Any) -> F32:
    """Return the image of some Gaussians of the scene itself."""
    return clipped(rasterize(study.scene.gaussians[held], camera).images[0])


def one_panel(x: str, y: str) -> tuple[Figure, Any]:
    """Return a figure of one panel."""
    figure = Figure(figsize=(6.0, 4.2), dpi=120, layout="constrained")
    axes = figure.subplots()
    style(axes, x, y)
    return figure, axes


def style(axes: Any, x: str, y: str) -> None:
    """Label a panel, with a grid and no frame."""
    axes.set_xlabel(x)
    axes.set_ylabel(y)
    axes.grid(color=LIGHT.grid)
    axes.spines[["top", "right"]].set_visible(False)


def montage(rows: Sequence[Sequence[F32]], titles: Sequence[str], names: Sequence[str] = ()) -> bytes:
    """Return rows of images as one PNG, with a title above each column, and a name beside each row."""
    height, width = rows[0][0].shape[:2]
    lines = 1 + max(title.count("\n") for title in titles)
    tall = _PANEL * height / width * len(rows) + _LINE * (lines + len(rows))
    figure = Figure(figsize=(_PANEL * len(rows[0]), tall), dpi=110, layout="constrained")
    panels = figure.subplots(len(rows), len(rows[0]), squeeze=False)
    for row, images in zip(panels, rows, strict=True):
        for axes, image in zip(row, images, strict=True):
            axes.imshow(image)
            axes.set_axis_off()
            axes.set_anchor("S")  # what room is left goes to the titles
    for axes, title in zip(panels[0], titles, strict=True):
        axes.set_title(title, fontsize=10)
    for axes, name in zip(panels[:, 0], names, strict=False):
        axes.text(-0.03, 0.5, name, transform=axes.transAxes, rotation=90, ha="right", va="center", fontsize=10)
    return png(figure)


def png(figure: Figure) -> bytes:
    """Return a figure as PNG."""
    out = io.BytesIO()
    figure.savefig(out, format="png")
    return out.getvalue()


if __name__ == "__main__":
    main()
