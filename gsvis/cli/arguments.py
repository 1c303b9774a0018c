"""The commands and their arguments, as dataclasses that `tyro` turns into a command line and its help.

Nothing heavy is imported here: `gsvis --help` has to be quick.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from gsvis.cli.arguments_convert import Convert
from gsvis.cli.arguments_edit import Clean, Cut, Paint
from gsvis.cli.arguments_export import Export
from gsvis.cli.arguments_package import Prepare, Unpack, Verify
from gsvis.cli.arguments_serve import Serve
from gsvis.cli.arguments_simulate import Simulate
from gsvis.cli.arguments_space import Space
from gsvis.cli.arguments_view import View
from gsvis.cli.arguments_where import SHOW, Framed, Where, WhereSeen
from gsvis.cli.arguments_world import World
from gsvis.cli.readers import (
    BYTES,
    CELLS,
    COLOR,
    COUNTED,
    DEGREES,
    DISTANCE,
    ELEVATION,
    EPSILON,
    FACE_PIXELS,
    FACE_RAYS,
    FACTOR,
    INDICES,
    MEAN_TERMS,
    NAMES,
    PIXEL,
    PIXELS,
    PLAIN,
    POINT,
    PREVIEW_SHARE,
    RATE,
    SH_DEGREE,
    SHARE,
    SHARES,
    STEPS,
    TAU,
    TERMS,
    WEIGHT,
    WHOLE,
    Flag,
    Lod,
    Scene,
    hint,
)

__all__ = [
    "Analyze",
    "Clean",
    "Color",
    "Command",
    "Convert",
    "Cut",
    "Export",
    "Inspect",
    "Levels",
    "Paint",
    "Prepare",
    "Pvs",
    "PvsReport",
    "Render",
    "Serve",
    "Simulate",
    "Space",
    "Train",
    "Unpack",
    "Verify",
    "View",
    "World",
]


@dataclass(frozen=True)
class Inspect(WhereSeen):
    """Report what a scene holds and what looks wrong with it."""

    scene: Scene
    """File or folder (.ply, .splat, .ksplat, .spz, .sog, .glb, .pt, .ckpt, lod-meta.json), or builtin:NAME."""
    lod: Lod = None
    """Level of detail of a streamed scene; 0 is the finest."""
    histograms: Flag = False
    """Show how opacities, sizes, shapes, distances and SH are spread, too."""
    json: Flag = False
    """Print one JSON document instead of tables."""
    drop_invalid: Flag = False
    """Leave out rows whose values are no numbers, and say how many; else they are an error."""
    debug: Flag = False
    """Show the traceback of an error."""


@dataclass(frozen=True)
class Analyze(Where):
    """Trace what views need and from where each Gaussian is visible; write a report."""

    scene: Scene
    """File or folder (.ply, .splat, .ksplat, .spz, .sog, .glb, .pt, .ckpt, lod-meta.json), or builtin:NAME."""
    out: Annotated[str, arg(aliases=["-o"], metavar="DIR", help_behavior_hint="(required)")]
    """Folder for report.html (all in one file), report.json and the pictures; made if missing."""
    lod: Lod = None
    """Level of detail of a streamed scene; 0 is the finest."""
    cameras: Annotated[str | None, arg(metavar="FILE", help_behavior_hint="(default: sampled)")] = None
    """Cameras to analyze: a COLMAP model, transforms.json, cameras.json, or report.json of an earlier run, whose views
    are repeated exactly. Without it cameras are sampled in navigable space."""
    views: Annotated[int | None, COUNTED, hint("16; with --cameras all")] = None
    """Number of views: cameras to sample, or to take from FILE at even steps."""
    width: Annotated[int | None, PIXELS, hint("256")] = None
    """Pixels across a view; one ray each."""
    height: Annotated[int | None, PIXELS, hint("192; with --cameras by its aspect")] = None
    """Pixels down a view."""
    fov: Annotated[float | None, DEGREES, hint("60; with --cameras its own")] = None
    """Horizontal field of view of sampled cameras."""
    seed: Annotated[int, WHOLE] = 0
    """Seed of everything random: the same seed gives the same report."""
    tau: Annotated[float, WEIGHT, hint("1/255")] = 1.0 / 255.0
    """Weight from which a Gaussian counts as visible."""
    traced_sample: Annotated[int, WHOLE] = 5000
    """Gaussians whose directions are traced outward; 0 for none."""
    rays_per_face: Annotated[int, FACE_RAYS] = 16
    """Rays of that tracing over each of the 80 directions: 1, 4, 16 or 64; more find more."""
    json: Flag = False
    """Print one JSON document, report.json, instead of tables."""
    drop_invalid: Flag = False
    """Leave out rows whose values are no numbers, and say how many; else they are an error."""
    debug: Flag = False
    """Show the traceback of an error."""


@dataclass(frozen=True)
class Render(Where):
    """Draw a scene as cameras see it; list who contributes to a pixel."""

    scene: Scene
    """File or folder (.ply, .splat, .ksplat, .spz, .sog, .glb, .pt, .ckpt, lod-meta.json), or builtin:NAME."""
    out: Annotated[
        str | None, arg(aliases=["-o"], metavar="OUT", help_behavior_hint="(required without --contributors)")
    ] = None
    """A .png for one camera, a .gif for an animation, or a folder for 0000.png, 0001.png and on; made if missing."""
    lod: Lod = None
    """Level of detail of a streamed scene; 0 is the finest."""
    cameras: Annotated[
        str | None, arg(metavar="FILE", help_behavior_hint="(default: one camera, sampled in navigable space)")
    ] = None
    """Cameras to draw: a COLMAP model, transforms.json, cameras.json, or report.json of gsvis analyze; all of them, or
    those of --index."""
    index: Annotated[tuple[int, ...] | None, INDICES, hint("all")] = None
    """Which cameras of FILE, counted from 0."""
    orbit: Annotated[int | None, COUNTED, hint("no orbit")] = None
    """N cameras on a circle around the scene, or around --target."""
    radius: Annotated[float | None, DISTANCE, hint("shows the middle 90% of the scene")] = None
    """Distance of the orbit from what it goes around, scene units."""
    elevation: Annotated[float | None, ELEVATION, hint("20")] = None
    """Height of the orbit above what it goes around."""
    eye: Annotated[tuple[float, ...] | None, POINT, hint("none")] = None
    """One camera at this point."""
    target: Annotated[tuple[float, ...] | None, POINT, hint("the middle of the scene")] = None
    """What --eye looks at, or --orbit goes around."""
    up: Annotated[str | None, arg(metavar="UP", help_behavior_hint="(default: the likely one)")] = None
    """Up in the image: an axis such as -y, or three numbers; not with --cameras."""
    seed: Annotated[int, WHOLE] = 0
    """Seed of everything random: the same seed gives the same view."""
    width: Annotated[int | None, PIXELS, hint("640; with --cameras that of FILE")] = None
    """Pixels across the pictures."""
    height: Annotated[int | None, PIXELS, hint("480; with --cameras by its aspect")] = None
    """Pixels down the pictures."""
    fov: Annotated[float | None, DEGREES, hint("60; with --cameras its own")] = None
    """Horizontal field of view."""
    background: Annotated[tuple[float, ...], COLOR, hint("0 0 0")] = (0.0, 0.0, 0.0)
    """Color behind everything, each channel in [0, 1]."""
    sh_degree: Annotated[int | None, SH_DEGREE, hint("all there is")] = None
    """Highest degree of spherical harmonics that is drawn."""
    antialiased: Flag = False
    """Lower opacities so that small Gaussians keep their light; for scenes trained that way."""
    depth: Flag = False
    """Write depth pictures too (NAME_depth.png or NAME_depth.gif)."""
    fps: Annotated[float | None, RATE, hint("12")] = None
    """Frames a second of a .gif."""
    contributors: Annotated[tuple[int, int] | None, PIXEL, hint("none")] = None
    """List the Gaussians blended into the pixel in column X and row Y, front to back; for one camera."""
    backend: Annotated[Literal["auto", "cpu", "cuda", "reference"], PLAIN] = "auto"
    """Renderer; auto uses a GPU if there is one that can draw. (default: auto)"""
    overwrite: Flag = False
    """Replace pictures that exist and that something else wrote; those of gsvis render are replaced without it."""
    json: Flag = False
    """Print one JSON document instead of lines."""
    drop_invalid: Flag = False
    """Leave out rows whose values are no numbers, and say how many; else they are an error."""
    debug: Flag = False
    """Show the traceback of an error."""


@dataclass(frozen=True)
class Pvs(WhereSeen):
    """Find what is visible from each cell of a scene; write it as a store."""

    scene: Scene
    """File or folder (.ply, .splat, .ksplat, .spz, .sog, .glb, .pt, .ckpt, lod-meta.json), or builtin:NAME."""
    out: Annotated[str, arg(aliases=["-o"], metavar="FILE", help_behavior_hint="(required)")]
    """The store to write, such as scene.pvs; an existing one is replaced when the new one is complete."""
    lod: Lod = None
    """Level of detail of a streamed scene; 0 is the finest."""
    cells: Annotated[int | None, CELLS, hint("512, or 128 around an object whose sets hardly grow then")] = None
    """Largest number of cells. They are as small as it allows."""
    cell_size: Annotated[float | None, DISTANCE, hint("the smallest that --cells allows")] = None
    """Side of a cell, scene units."""
    up: Annotated[str | None, arg(metavar="UP", help_behavior_hint="(default: the likely one)")] = None
    """Up in the scene: an axis such as -y, or three numbers."""
    method: Annotated[Literal["hybrid", "raster", "raycast"], PLAIN] = "hybrid"
    """z-buffer and hidden points, cubemap images, or rays. (default: hybrid)"""
    face_size: Annotated[int | None, FACE_PIXELS, hint("768")] = None
    """Pixels along a side of the six faces around a viewpoint of a cell."""
    tau: Annotated[float, TAU, hint("1/255")] = 1.0 / 255.0
    """Weight from which a Gaussian counts as visible."""
    limit: Annotated[float | None, SHARE, hint("0.0015")] = None
    """The set of a cell is finished when rays prove that it misses at most this share of the light."""
    certify: Annotated[int | None, COUNTED, hint("8192")] = None
    """Largest number of random rays in each cell that bound the light its set misses."""
    max_inner: Annotated[int | None, WHOLE, hint("16")] = None
    """Largest number of times that a set is mended and certified again."""
    workers: Annotated[int | None, COUNTED, hint("one for each core")] = None
    """Number of processes; fewer if --max-memory requires it. The sets are the same for any number."""
    max_memory: Annotated[int | None, BYTES, hint("no bound")] = None
    """Memory limit of all processes together, such as 4GB or 2GiB."""
    scheduler: Annotated[str | None, arg(metavar="ADDRESS", help_behavior_hint="(default: this machine)")] = None
    """Dask scheduler whose workers do the work, such as tcp://10.0.0.5:8786; needs the extra 'cluster'."""
    show: Annotated[str | None, SHOW] = None
    """Write a picture of where people stand: the first view, and a plan with eyes; a dry run in doubt does anyway."""
    dry_run: Flag = False
    """Print time, memory and disk after a few cells were tried, and write nothing."""
    json: Flag = False
    """Print one JSON document instead of tables."""
    drop_invalid: Flag = False
    """Leave out rows whose values are no numbers, and say how many; else they are an error."""
    debug: Flag = False
    """Show the traceback of an error."""


@dataclass(frozen=True)
class PvsReport(Framed):
    """Measure how good the sets of a store are; write a report."""

    store: Annotated[Positional[str], arg(metavar="STORE", help_behavior_hint="")]
    """What gsvis pvs wrote."""
    scene: Scene
    """The scene it was built from: a file or folder, or builtin:NAME."""
    out: Annotated[str, arg(aliases=["-o"], metavar="DIR", help_behavior_hint="(required)")]
    """Folder for report.html (all in one file), report.json and the pictures; made if missing."""
    lod: Lod = None
    """Level of detail of a streamed scene; 0 is the finest."""
    cameras: Annotated[str | None, arg(metavar="FILE", help_behavior_hint="(default: none)")] = None
    """Cameras that judge the sets too: a COLMAP model, transforms.json or cameras.json."""
    cells: Annotated[int, COUNTED] = 10
    """Largest number of cells to measure; drawn at random where there are more."""
    eyes: Annotated[int, COUNTED] = 4
    """Number of eyes in each of these cells, which no set was made from."""
    dense: Annotated[int, WHOLE] = 27
    """Number of further eyes in each cell: the set is compared in size with what they see together; 0 for none."""
    width: Annotated[int, PIXELS] = 480
    """Pixels across the images."""
    height: Annotated[int, PIXELS] = 360
    """Pixels down the images."""
    fov: Annotated[float, DEGREES, hint("70")] = 70.0
    """Horizontal field of view of the images."""
    raycast: Flag = False
    """Also trace rays from these eyes."""
    certify: Annotated[int, WHOLE] = 8192
    """Largest number of random rays in each cell that bound the light its set misses; 0 for none."""
    bytes_per_gaussian: Annotated[int | None, COUNTED, hint("32 bits for each attribute")] = None
    """Bytes that sending one Gaussian costs."""
    seed: Annotated[int, WHOLE] = 0
    """Seed of everything random: the same seed gives the same report."""
    json: Flag = False
    """Print one JSON document, report.json, instead of tables."""
    drop_invalid: Flag = False
    """Leave out rows whose values are no numbers, and say how many; else they are an error."""
    debug: Flag = False
    """Show the traceback of an error."""


@dataclass(frozen=True)
class Color(WhereSeen):
    """Replace SH colors with a base color and a few terms that can be sent in pieces."""

    scene: Scene
    """File or folder (.ply, .splat, .ksplat, .spz, .sog, .glb, .pt, .ckpt, lod-meta.json), or builtin:NAME."""
    out: Annotated[str, arg(aliases=["-o"], metavar="FILE", help_behavior_hint="(required)")]
    """The Arrow file to write, such as scene.arrow: geometry, base colors and terms; replaced if it exists."""
    lod: Lod = None
    """Level of detail of a streamed scene; 0 is the finest."""
    pvs: Annotated[str | None, arg(metavar="FILE", help_behavior_hint="(default: directions are traced)")] = None
    """Visible sets of SCENE (gsvis pvs): they hold from where each Gaussian is seen."""
    variant: Annotated[Literal["hsl", "hsl-l", "hsv", "yuv", "axis", "axes", "axes-split", "rgb"], PLAIN] = "rgb"
    """How colors are split; the first four are the paper's. (default: rgb)"""
    max_terms: Annotated[int | None, TERMS, hint("24")] = None
    """Most terms of each function of a Gaussian; 0 leaves base colors alone."""
    mean_terms: Annotated[float | None, MEAN_TERMS, hint("3")] = None
    """Terms a Gaussian on average; they go where they lower errors most. all: all that help (slow)."""
    no_refine: Flag = False
    """Leave terms on the grid that they are chosen from: quicker, and worse."""
    views: Annotated[int, COUNTED] = 256
    """Number of views that measure how much each Gaussian counts."""
    held_out: Annotated[int, WHOLE] = 8
    """Number of further views to measure on, for the comparison with SH; 0 for none."""
    width: Annotated[int, PIXELS] = 480
    """Pixels across these views, and across those of --epsilon auto and --staircase."""
    height: Annotated[int, PIXELS] = 360
    """Pixels down these views."""
    up: Annotated[str | None, arg(metavar="UP", help_behavior_hint="(default: the likely one)")] = None
    """Up in the scene: an axis such as -y, or three numbers; not with --pvs."""
    seed: Annotated[int, WHOLE] = 0
    """Seed of everything random: the same seed gives the same file."""
    precision: Annotated[Literal["coarse", "wire", "fine", "exact"], PLAIN] = "wire"
    """Bits of what is written; exact keeps 32 bits a number. (default: wire)"""
    epsilon: Annotated[float | None, EPSILON, hint("auto where it is needed")] = None
    """Smallest change of a color for which a term is sent; auto asks the metric FLIP what an eye would see."""
    active: Annotated[str | None, arg(metavar="FILE", help_behavior_hint="(default: none)")] = None
    """Write the terms that each cell of --pvs needs, such as scene.terms.arrow."""
    report: Annotated[str | None, arg(metavar="DIR", help_behavior_hint="(default: none)")] = None
    """Report to write: a folder for report.html (all in one file), report.json and the pictures; made if missing."""
    staircase: Annotated[str | None, arg(metavar="FILE", help_behavior_hint="(default: none)")] = None
    """Write a web page on which a person finds their own epsilon, such as test.html."""
    max_memory: Annotated[int | None, BYTES, hint("no bound")] = None
    """Memory limit, such as 8GB: a scene that needs more is refused before it is read."""
    json: Flag = False
    """Print one JSON document instead of tables."""
    drop_invalid: Flag = False
    """Leave out rows whose values are no numbers, and say how many; else they are an error."""
    debug: Flag = False
    """Show the traceback of an error."""


@dataclass(frozen=True)
class Train:
    """Train a scene on photographs with a reconstruction."""

    source: Annotated[Positional[str], arg(metavar="PHOTOS", help_behavior_hint="")]
    """Folder of photographs with a COLMAP model (undistorted), or with a transforms.json."""
    out: Annotated[str, arg(aliases=["-o"], metavar="FILE", help_behavior_hint="(required)")]
    """The scene to write, .ply, .spz, .sog or .ksplat. Its record goes beside it: scene.train.json."""
    images: Annotated[str | None, arg(metavar="DIR", help_behavior_hint="(default: images, beside the model)")] = None
    """Folder of the photographs alone, where it lies elsewhere."""
    width: Annotated[int | None, PIXELS, hint("theirs")] = None
    """Pixels across the photographs, which are shrunk to it; with --height."""
    height: Annotated[int | None, PIXELS, hint("theirs")] = None
    """Pixels down the photographs; with --width."""
    downscale: Annotated[float | None, FACTOR, hint("1")] = None
    """Shrink the photographs by this factor instead."""
    steps: Annotated[int, STEPS] = 7000
    """Steps of training, one photograph each. The schedule of 3DGS is shortened with them."""
    sh_degree: Annotated[int, SH_DEGREE] = 3
    """Highest degree of spherical harmonics, which colors grow to."""
    max_gaussians: Annotated[int | None, COUNTED, hint("5000000")] = None
    """Largest number of Gaussians."""
    test_every: Annotated[int, WHOLE] = 8
    """Keep every N-th photograph, by name, from training and measure on it; 0 for none."""
    evaluate_every: Annotated[int, WHOLE] = 1000
    """Steps from one measurement to the next; 0 for one at the end."""
    random_points: Annotated[int | None, COUNTED, hint("50000 where there are none")] = None
    """Number of random points to begin with, instead of those of the reconstruction."""
    seed: Annotated[int, WHOLE] = 0
    """Seed of everything random: the same seed gives the same scene."""
    backend: Annotated[Literal["auto", "cpu", "cuda"], PLAIN] = "auto"
    """Renderer; auto uses a GPU if there is one that can draw. (default: auto)"""
    checkpoint: Annotated[str | None, arg(metavar="FILE", help_behavior_hint="(default: OUT.checkpoint)")] = None
    """File that keeps an unfinished run. The same command resumes from it; it is removed at the end."""
    checkpoint_seconds: Annotated[int, COUNTED] = 120
    """Seconds between two writes of the checkpoint: what a kill may cost."""
    restart: Flag = False
    """Ignore a checkpoint and begin again."""
    overwrite: Flag = False
    """Replace OUT if it exists. To resume from a checkpoint needs no --overwrite."""
    json: Flag = False
    """Print one JSON document, the record, instead of a table."""
    debug: Flag = False
    """Show the traceback of an error."""


@dataclass(frozen=True)
class Levels(WhereSeen):
    """Make lower levels of a scene that share most of their Gaussians with it."""

    scene: Scene
    """File or folder (.ply, .splat, .ksplat, .spz, .sog, .glb, .pt, .ckpt, lod-meta.json), or builtin:NAME."""
    out: Annotated[str, arg(aliases=["-o"], metavar="DIR", help_behavior_hint="(required)")]
    """Folder for low.ply, medium.ply, high.ply and levels.arrow, which lists what they share; made if missing."""
    lod: Lod = None
    """Level of detail of a streamed scene to start from; 0 is the finest."""
    photos: Annotated[str | None, arg(metavar="DIR", help_behavior_hint="(default: renders of the scene)")] = None
    """Photographs to train on, with the COLMAP model or transforms.json that SCENE was trained from."""
    levels: Annotated[tuple[float, ...], SHARES, hint("0.25 0.5")] = (0.25, 0.5)
    """Size of each lower level as a share of the scene's, lowest first."""
    reuse: Annotated[tuple[float, ...] | None, SHARES, hint("0.9 0.96")] = None
    """Least share of each lower level that stands unchanged in the next."""
    names: Annotated[tuple[str, ...] | None, NAMES, hint("low medium high")] = None
    """Names of these levels and their files, that of the scene itself last."""
    preview: Annotated[float | None, PREVIEW_SHARE, hint("0.02; 0 below 50,000 Gaussians")] = None
    """Size of the first picture, merged Gaussians below all other levels, as a share of the scene's; 0 for none."""
    steps: Annotated[int, STEPS] = 400
    """Steps of training for each lower level, one view each."""
    views: Annotated[int | None, COUNTED, hint("400")] = None
    """Number of views to train on, sampled where viewers may stand; not with --photos, which trains on 7 of 8."""
    held_out: Annotated[int | None, WHOLE, hint("12")] = None
    """Number of further views to measure on; 0 for none. With --photos it is every 8th."""
    width: Annotated[int | None, PIXELS, hint("480; with --photos theirs")] = None
    """Pixels across the views to measure on; those to train on are wider and smaller. Photographs are shrunk to it."""
    height: Annotated[int | None, PIXELS, hint("360; with --photos theirs")] = None
    """Pixels down these views."""
    up: Annotated[str | None, arg(metavar="UP", help_behavior_hint="(default: the likely one)")] = None
    """Up in the scene: an axis such as -y, or three numbers; not with --photos."""
    seed: Annotated[int, WHOLE] = 0
    """Seed of everything random: the same seed gives the same levels."""
    show: Annotated[str | None, SHOW] = None
    """Write a picture of where people stand: the first view, and a plan with eyes."""
    max_memory: Annotated[int | None, BYTES, hint("no bound")] = None
    """Memory limit, such as 8GB: a scene that needs more is refused before it is read."""
    json: Flag = False
    """Print one JSON document instead of tables."""
    drop_invalid: Flag = False
    """Leave out rows whose values are no numbers, and say how many; else they are an error."""
    debug: Flag = False
    """Show the traceback of an error."""


Command = (
    Inspect
    | Analyze
    | Render
    | Pvs
    | PvsReport
    | Color
    | Train
    | Levels
    | Clean
    | Convert
    | Cut
    | Paint
    | Prepare
    | World
    | Verify
    | Unpack
    | Export
    | Space
    | View
    | Serve
    | Simulate
)
