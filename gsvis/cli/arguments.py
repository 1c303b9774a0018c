"""The commands and their options, as dataclasses that `tyro` turns into a command line and its help.

Nothing heavy is imported here: `gsvis --help` has to be quick.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from gsvis.cli import readers
from gsvis.cli.arguments_edit import Clean, Convert, Cut, Paint, Train
from gsvis.cli.arguments_publish import Export, Prepare, Serve, Space, Unpack, Verify, View, World
from gsvis.cli.options import (
    IN_DOUBT,
    REPORT,
    UP,
    Cluster,
    Fit,
    Framed,
    Placed,
    Reading,
    Sending,
    Sets,
    Shown,
    Where,
    with_help,
)
from gsvis.cli.options import (
    Levels as Training,
)
from gsvis.cli.readers import AsInPaper, Count, Device, File, Flag, Lod, Memory, Report, Scene, Seed, hint, out

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
class Inspect:
    """Report what a scene holds and what looks wrong with it."""

    scene: Scene
    lod: Lod = None
    histograms: Flag = False
    """Show how opacities, sizes, shapes, distances and SH are spread, too."""
    overdraw: Annotated[Count, hint("not measured")] = None
    """Cells of a package, or eyes in a scene, at which to count the splats over a pixel and in a view, such as 12."""
    where: Where = Where()
    output: Reading = Reading()


@dataclass(frozen=True, kw_only=True)
class Tracing:
    """How a scene is analyzed: `gsvis.raycast.analysis.AnalysisConfig`."""

    seed: Seed = 0
    tau: Annotated[float, readers.WEIGHT, hint("1/255")] = 1.0 / 255.0
    """Weight from which a Gaussian counts as visible."""
    traced_sample: Annotated[int, readers.WHOLE] = 5000
    """Gaussians whose directions are traced outward; 0 for none."""
    tracer: Annotated[Literal["hierarchy", "embree"], readers.PLAIN] = "hierarchy"
    """What traces rays. hierarchy: our own, over ellipsoids; embree: Open3D's Embree, over proxy meshes, many times
    slower. (default: hierarchy)"""
    rays_per_face: Annotated[int, readers.FACE_RAYS] = 16
    """Rays of that tracing over each of the 80 directions: 1, 4, 16 or 64; more find more."""


@dataclass(frozen=True)
class Analyze:
    """Trace what views need and from where each Gaussian is visible; write a report."""

    scene: Scene
    out: Report
    lod: Lod = None
    where: Annotated[
        Where,
        with_help(
            {"cameras": "sampled"},
            cameras="Cameras to analyze: a COLMAP model, transforms.json, cameras.json, or report.json of an earlier"
            " run, whose views are repeated exactly. Without it cameras are sampled in navigable space.",
        ),
    ] = Where()
    views: Annotated[Count, hint("16; with --cameras all")] = None
    """Number of views: cameras to sample, or to take from FILE at even steps."""
    width: Annotated[int | None, readers.PIXELS, hint("256")] = None
    """Pixels across a view; one ray each."""
    height: Annotated[int | None, readers.PIXELS, hint("192; with --cameras by its aspect")] = None
    """Pixels down a view."""
    fov: Annotated[float | None, readers.DEGREES, hint("60; with --cameras its own")] = None
    """Horizontal field of view of sampled cameras."""
    as_in_paper: AsInPaper = False
    tracing: Tracing = Tracing()
    device: Device = "auto"
    """Device that draws and trains. auto: cuda where torch and gsplat can use a GPU here, else cpu. It draws the
    picture of where people stand; rays are traced on the CPU. (default: auto)"""
    output: Annotated[Reading, REPORT] = Reading()


@dataclass(frozen=True, kw_only=True)
class Cast:
    """Which cameras are drawn."""

    index: Annotated[tuple[int, ...] | None, readers.INDICES, hint("all")] = None
    """Which cameras of FILE, counted from 0."""
    orbit: Annotated[Count, hint("no orbit")] = None
    """N cameras on a circle around the scene, or around --target."""
    radius: Annotated[float | None, readers.DISTANCE, hint("shows the middle 90% of the scene")] = None
    """Distance of the orbit from what it goes around, scene units."""
    elevation: Annotated[float | None, readers.ELEVATION, hint("20")] = None
    """Height of the orbit above what it goes around."""
    eye: Annotated[tuple[float, ...] | None, readers.POINT, hint("none")] = None
    """One camera at this point."""
    target: Annotated[tuple[float, ...] | None, readers.POINT, hint("the middle of the scene")] = None
    """What --eye looks at, or --orbit goes around."""
    view: Annotated[str | None, hint("none", "LINK")] = None
    """The view of a link to a page of the viewer, or its part behind '#': '#eye=1,2,1.6&to=4,2,1&fov=60'."""


@dataclass(frozen=True, kw_only=True)
class Picture:
    """How a picture is drawn."""

    width: Annotated[int | None, readers.PIXELS, hint("640; with --cameras that of FILE")] = None
    """Pixels across the pictures."""
    height: Annotated[int | None, readers.PIXELS, hint("480; with --cameras by its aspect")] = None
    """Pixels down the pictures."""
    fov: Annotated[float | None, readers.DEGREES, hint("60; with --cameras its own")] = None
    """Horizontal field of view."""
    background: Annotated[tuple[float, ...], readers.COLOR, hint("0 0 0")] = (0.0, 0.0, 0.0)
    """Color behind everything, each channel in [0, 1]."""
    sh_degree: Annotated[int | None, readers.SH_DEGREE, hint("all there is")] = None
    """Highest degree of spherical harmonics that is drawn."""
    antialiased: Flag = False
    """Lower opacities so that small Gaussians keep their light; for scenes trained that way."""
    depth: Flag = False
    """Write depth pictures too (NAME_depth.png or NAME_depth.gif)."""
    fps: Annotated[float | None, readers.RATE, hint("12")] = None
    """Frames a second of a .gif."""


@dataclass(frozen=True)
class Render:
    """Draw a scene as cameras see it; list who contributes to a pixel."""

    scene: Scene
    out: Annotated[str | None, out("OUT", "(required without --contributors)")] = None
    """A .png for one camera, a .gif for an animation, or a folder for 0000.png, 0001.png and on; made if missing."""
    lod: Lod = None
    where: Annotated[
        Placed,
        with_help(
            {"cameras": "one camera, sampled in navigable space"},
            cameras="Cameras to draw: a COLMAP model, transforms.json, cameras.json, or report.json of gsvis analyze;"
            " all of them, or those of --index.",
            up="Up in the image: an axis such as -y, or three numbers; not with --cameras.",
        ),
    ] = Placed()
    cast: Cast = Cast()
    seed: Seed = 0
    picture: Picture = Picture()
    contributors: Annotated[tuple[int, int] | None, readers.PIXEL, hint("none")] = None
    """List the Gaussians blended into the pixel in column X and row Y, front to back; for one camera."""
    device: Device = "auto"
    """Device that draws and trains. auto: cuda where torch and gsplat can use a GPU here, else cpu. It draws pictures;
    the list of contributors is made on the CPU. (default: auto)"""
    reference: Flag = False
    """Draw by the plain renderer that the others are compared with, on the CPU; hundreds of times slower."""
    overwrite: Flag = False
    """Replace pictures that exist and that something else wrote; those of gsvis render are replaced without it."""
    output: Reading = Reading()


@dataclass(frozen=True, kw_only=True)
class CertifiedSets(Sets):
    """How visible sets are found and certified, with a store as the result."""

    method: Annotated[Literal["hybrid", "raster", "raycast"], readers.PLAIN] = "hybrid"
    """z-buffer and hidden points, cubemap images, or rays. (default: hybrid)"""
    tau: Annotated[float, readers.TAU, hint("1/255")] = 1.0 / 255.0
    """Weight from which a Gaussian counts as visible."""
    certify: Annotated[int | None, readers.WHOLE, hint("8192")] = None
    """Largest number of random rays in each cell that bound the light its set misses; 0 for none: the set stays as the
    z-buffer and hidden points found it, the paper's way."""
    max_inner: Annotated[int | None, readers.WHOLE, hint("16")] = None
    """Largest number of times that a set is mended and certified again."""
    tracer: Annotated[Literal["hierarchy", "embree"], readers.PLAIN] = "hierarchy"
    """What traces rays. hierarchy: our own, over ellipsoids; embree: Open3D's Embree, over proxy meshes, many times
    slower. (default: hierarchy)"""


@dataclass(frozen=True)
class Pvs:
    """Find what is visible from each cell of a scene; write it as a store."""

    scene: Scene
    out: Annotated[str, out("FILE")]
    """The store to write, such as scene.pvs; an existing one is replaced when the new one is complete."""
    lod: Lod = None
    where: Annotated[Shown, with_help(show=IN_DOUBT)] = Shown()
    sets: Annotated[CertifiedSets, with_help({"cells": "512, or 128 where sets hardly grow then"})] = CertifiedSets()
    work: Annotated[
        Cluster,
        with_help(
            workers="Number of processes; fewer if --max-memory requires it. The sets are the same for any number.",
            dry_run="Print time, memory and disk after a few cells were tried, and write nothing.",
        ),
    ] = Cluster()
    device: Device = "auto"
    """Device that draws and trains. auto: cuda where torch and gsplat can use a GPU here, else cpu. Visible sets are
    found on the CPU, whatever it is. (default: auto)"""
    output: Reading = Reading()


@dataclass(frozen=True, kw_only=True)
class Quality:
    """How visible sets are measured: `gsvis.pvs.quality.QualityConfig`."""

    cells: Annotated[int, readers.COUNTED] = 10
    """Largest number of cells to measure; drawn at random where there are more."""
    eyes: Annotated[int, readers.COUNTED] = 4
    """Number of eyes in each of these cells, which no set was made from."""
    dense: Annotated[int, readers.WHOLE] = 27
    """Number of further eyes in each cell: the set is compared in size with what they see together; 0 for none."""
    width: Annotated[int, readers.PIXELS] = 480
    """Pixels across the images."""
    height: Annotated[int, readers.PIXELS] = 360
    """Pixels down the images."""
    fov: Annotated[float, readers.DEGREES] = 70.0
    """Horizontal field of view of the images."""
    raycast: Flag = False
    """Also trace rays from these eyes."""
    certify: Annotated[int, readers.WHOLE] = 8192
    """Largest number of random rays in each cell that bound the light its set misses; 0 for none."""
    bytes_per_gaussian: Annotated[Count, hint("32 bits for each attribute")] = None
    """Bytes that sending one Gaussian costs."""
    seed: Seed = 0


@dataclass(frozen=True)
class PvsReport:
    """Measure how good the sets of a store are; write a report."""

    store: Annotated[Positional[str], arg(metavar="STORE", help_behavior_hint="")]
    """What gsvis pvs wrote."""
    scene: Scene
    """The scene it was built from: a file or folder, or builtin:NAME."""
    out: Report
    lod: Lod = None
    where: Annotated[
        Framed,
        with_help(
            {"cameras": "none"},
            cameras="Cameras that judge the sets too: a COLMAP model, transforms.json or cameras.json.",
        ),
    ] = Framed()
    quality: Quality = Quality()
    output: Annotated[Reading, REPORT] = Reading()


@dataclass(frozen=True, kw_only=True)
class Compared:
    """The views that weigh Gaussians, and those that measure the result."""

    views: Annotated[int, readers.COUNTED] = 256
    """Number of views that measure how much each Gaussian counts."""
    held_out: Annotated[int, readers.WHOLE] = 8
    """Number of further views to measure on, for the comparison with SH; 0 for none."""
    width: Annotated[int, readers.PIXELS] = 480
    """Pixels across these views, and across those of --epsilon auto."""
    height: Annotated[int, readers.PIXELS] = 360
    """Pixels down these views."""
    seed: Seed = 0


@dataclass(frozen=True, kw_only=True)
class Learning:
    """What the fitted colors learn from, and what draws it."""

    photos: Annotated[str | None, hint("none", "DIR")] = None
    """Photographs to train colors on, with the COLMAP model or transforms.json that SCENE was trained from."""
    downscale: Annotated[float | None, readers.FACTOR, hint("1")] = None
    """Shrink the photographs by this factor."""
    color_steps: Annotated[int | None, readers.WHOLE, hint("300")] = None
    """Steps of learning, one view each: photographs, or renders of SCENE without --photos, kept if held-out renders
    gain; 0 keeps the fit."""
    device: Device = "auto"
    """Device that draws and trains. auto: cuda where torch and gsplat can use a GPU here, else cpu. It draws while
    colors are learned; they are fitted and measured on the CPU. (default: auto)"""


@dataclass(frozen=True)
class Color:
    """Replace SH colors with a base color and a few terms that can be sent in pieces."""

    scene: Scene
    out: Annotated[str, out("FILE")]
    """The Arrow file to write, such as scene.arrow: geometry, base colors and terms; replaced if it exists."""
    lod: Lod = None
    pvs: Annotated[str | None, hint("directions are traced", "FILE")] = None
    """Visible sets of SCENE (gsvis pvs): they hold from where each Gaussian is seen."""
    where: Annotated[Placed, with_help(up=f"{UP}; not with --pvs.")] = Placed()
    as_in_paper: AsInPaper = False
    fit: Fit = Fit()
    learning: Learning = Learning()
    compared: Compared = Compared()
    precision: Annotated[Literal["coarse", "wire", "fine", "exact"], readers.PLAIN] = "wire"
    """Bits of colors and terms as they are written; exact keeps 32 bits a number. (default: wire)"""
    epsilon: Annotated[float | None, readers.EPSILON, hint("auto where it is needed")] = None
    """Smallest change of a color for which a term is sent; auto asks the metric FLIP what an eye would see."""
    active: File = None
    """Write the terms that each cell of --pvs needs, such as scene.terms.arrow."""
    report: Annotated[str | None, hint("none", "DIR")] = None
    """Report to write: a folder for report.html (all in one file), report.json and the pictures; made if missing."""
    max_memory: Memory = None
    output: Reading = Reading()


@dataclass(frozen=True, kw_only=True)
class MeasuredLevels(Training):
    """How lower levels are made and measured."""

    levels: Annotated[tuple[float, ...], readers.SHARES, hint("0.25 0.5")] = (0.25, 0.5)
    """Size of each lower level as a share of the scene's, lowest first."""
    held_out: Annotated[int | None, readers.WHOLE, hint("12")] = None
    """Number of further views to measure on; 0 for none. With --photos it is every 8th."""


@dataclass(frozen=True)
class Levels:
    """Make lower levels of a scene that share most of their Gaussians with it."""

    scene: Scene
    out: Annotated[str, out("DIR")]
    """Folder for low.ply, medium.ply, high.ply and levels.arrow, which lists what they share; made if missing."""
    lod: Lod = None
    """Level of detail of a streamed scene to start from; 0 is the finest."""
    where: Annotated[Shown, with_help(up=f"{UP}; not with --photos.")] = Shown()
    training: Annotated[
        MeasuredLevels,
        with_help(
            photos="Photographs to train on, with the COLMAP model or transforms.json that SCENE was trained from.",
            names="Names of these levels and their files, that of the scene itself last.",
            width="Pixels across the views to measure on; those to train on are wider and smaller. Photographs are"
            " shrunk to it.",
        ),
    ] = MeasuredLevels()
    price_reuse: Flag = False
    """Also train levels of these sizes that reuse nothing, and state what reuse costs in dB; takes as long again."""
    as_in_paper: AsInPaper = False
    seed: Seed = 0
    max_memory: Memory = None
    device: Device = "auto"
    """Device that draws and trains. auto: cuda where torch and gsplat can use a GPU here, else cpu. It trains levels;
    what stays in them is chosen, and all is measured, on the CPU. (default: auto)"""
    output: Reading = Reading()


@dataclass(frozen=True, kw_only=True)
class Simulated:
    """The link of a viewer."""

    trace: Annotated[str | None, hint("--mbit", "FILE")] = None
    """Bandwidth over time: a recorded 5G log (.csv), or lines of seconds and Mbit/s."""
    mbit: Annotated[float | None, readers.MBIT, hint("10, without --trace")] = None
    """A link of one rate instead, Mbit/s."""
    round_trip: Annotated[float, readers.MILLISECONDS] = 40.0
    """Round-trip time of the link, milliseconds."""


@dataclass(frozen=True, kw_only=True)
class Viewing:
    """How long a viewer stays, and what is compared: `gsvis.simulate.ViewingConfig`."""

    seconds: Annotated[float, readers.SECONDS] = 30.0
    """How long the viewer stays in each scene."""
    width: Annotated[int, readers.PIXELS] = 320
    """Pixels across the views that are compared."""
    height: Annotated[int, readers.PIXELS] = 240
    """Pixels down these views."""
    fov: Annotated[float, readers.DEGREES] = 90.0
    """Horizontal field of view of the viewer."""
    every: Annotated[float, readers.SECONDS] = 0.5
    """Seconds between comparisons after the first three seconds; 0.1 before."""


@dataclass(frozen=True)
class Simulate:
    """Simulate what a viewer sees while a scene arrives over a link; write a report."""

    package: Annotated[Positional[tuple[str, ...]], readers.PACKAGES, readers.PLAIN]
    """Folders of packages or worlds, such as scene.gsvis; several are visited one after the other."""
    path: Annotated[str, arg(metavar="FILE", help_behavior_hint="(required)")]
    """Walk of the viewer: a CSV of poses (t,x,y,z,qw,qx,qy,qz) or an EyeNavGS recording. Moved into the
    scene if it lies outside."""
    out: Report
    link: Simulated = Simulated()
    viewing: Viewing = Viewing()
    visits: Annotated[Count, hint("one for each package")] = None
    """Number of visits, in the order of the packages, in turns; each begins with nothing."""
    as_in_paper: AsInPaper = False
    sending: Sending = Sending()
    scene: Annotated[tuple[str, ...], readers.FILES, hint("found beside each package")] = ()
    """The scene that each package was made from, or all scenes of one world, to compare with."""
    lod: Lod = None
    """Level of detail of a streamed --scene; 0 is the finest."""
    whole_file: Annotated[tuple[str, ...], readers.FILES, hint("the best of SOG and SPZ")] = ()
    """A file or folder of each scene; its size is used for the whole file."""
    no_retarget: Flag = False
    """Leave the path where it is, even outside of the scene."""
    seed: Seed = 0
    max_memory: Annotated[Memory, hint("no bound; worlds must fit this machine")] = None
    """Memory limit, such as 4GB: what needs more is refused. All records are read."""
    output: Annotated[Reading, REPORT] = Reading()


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
