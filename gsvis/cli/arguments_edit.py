"""The options of the commands that make and change scenes; see `gsvis.cli.arguments`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from gsvis.cli import readers
from gsvis.cli.options import UP, Output, Placed, Reading, Shown, with_help
from gsvis.cli.readers import Count, Device, FaceSize, File, Flag, Lod, Memory, Overwrite, Scene, Seed, hint, out

__all__ = ["Clean", "Convert", "Cut", "Paint", "Train"]


@dataclass(frozen=True, kw_only=True)
class Photographs:
    """The photographs that a scene is trained on."""

    images: Annotated[str | None, hint("images, beside the model", "DIR")] = None
    """Folder of the photographs alone, where it lies elsewhere."""
    width: Annotated[int | None, readers.PIXELS, hint("theirs")] = None
    """Pixels across the photographs, which are shrunk to it; with --height."""
    height: Annotated[int | None, readers.PIXELS, hint("theirs")] = None
    """Pixels down the photographs; with --width."""
    downscale: Annotated[float | None, readers.FACTOR, hint("1")] = None
    """Shrink the photographs by this factor."""


@dataclass(frozen=True, kw_only=True)
class Training:
    """How a scene is trained: `gsvis.train.trainer.TrainConfig`."""

    steps: Annotated[int, readers.STEPS] = 7000
    """Steps of training, one photograph each. The schedule of 3DGS is shortened with them."""
    sh_degree: Annotated[int, readers.SH_DEGREE] = 3
    """Highest degree of spherical harmonics, which colors grow to."""
    max_gaussians: Annotated[Count, hint("5000000")] = None
    """Largest number of Gaussians."""
    test_every: Annotated[int, readers.WHOLE] = 8
    """Keep every N-th photograph, by name, from training and measure on it; 0 for none."""
    evaluate_every: Annotated[int, readers.WHOLE] = 1000
    """Steps from one measurement to the next; 0 for one at the end."""
    random_points: Annotated[Count, hint("50000 where there are none")] = None
    """Number of random points to begin with, instead of those of the reconstruction."""
    seed: Seed = 0


@dataclass(frozen=True)
class Train:
    """Train a scene on photographs with a reconstruction."""

    source: Annotated[Positional[str], arg(metavar="PHOTOS", help_behavior_hint="")]
    """Folder of photographs with a COLMAP model (undistorted), or with a transforms.json."""
    out: Annotated[str, out("FILE")]
    """The scene to write, .ply, .compressed.ply, .spz, .sog or .ksplat. Its record goes beside it: scene.train.json."""
    photos: Photographs = Photographs()
    training: Training = Training()
    device: Device = "auto"
    """Device that draws and trains. auto: cuda where torch and gsplat can use a GPU here, else cpu. (default: auto)"""
    checkpoint: Annotated[str | None, hint("OUT.checkpoint", "FILE")] = None
    """File that keeps an unfinished run. The same command resumes from it; it is removed at the end."""
    checkpoint_seconds: Annotated[int, readers.COUNTED] = 120
    """Seconds between two writes of the checkpoint: what a kill may cost."""
    restart: Flag = False
    """Ignore a checkpoint and begin again."""
    overwrite: Flag = False
    """Replace OUT if it exists. To resume from a checkpoint needs no --overwrite."""
    output: Output = Output()


@dataclass(frozen=True, kw_only=True)
class Placement:
    """How a scene is turned and moved: arguments of `gsvis.io.convert.convert_scene`."""

    change_up: Annotated[str | None, hint("left as it is", "FROM:TO")] = None
    """Turn the scene so that axis FROM becomes TO, as in -y:+z."""
    scale: Annotated[float, readers.SCALE] = 1.0
    """Enlarge the scene by this factor, about the origin."""
    rotate: Annotated[tuple[float, ...] | None, readers.ANGLES, hint("no turn")] = None
    """Turn the scene about the origin: degrees about x, then y, then z, axes that stay fixed."""
    translate: Annotated[tuple[float, ...] | None, readers.POINT, hint("not moved")] = None
    """Move the scene, all of it. To place one scene beside another, convert it alone first."""


@dataclass(frozen=True)
class Convert:
    """Merge, crop, thin or move scenes, or change their format.

    gsvis convert IN OUT, or gsvis convert IN [IN ...] -o OUT.

    Steps come in the order of this list, whatever order you write them in.
    """

    paths: Annotated[Positional[tuple[str, ...]], readers.PATHS, readers.PLAIN]
    """Files or folders (.ply, .splat, .ksplat, .spz, .sog, .glb, .pt, .ckpt, lod-meta.json), or builtin:NAME. Several
    scenes become one, in their order. Without -o there is one scene, and OUT stands behind it."""
    out: Annotated[str | None, out("OUT", "(default: the last path)")] = None
    """File to write: .ply, .compressed.ply, .spz, .sog, .ksplat, or a page, .html. An existing one needs
    --overwrite."""
    lod: Annotated[tuple[int, ...] | None, readers.LODS, hint("the finest that is there")] = None
    """Level of detail of a streamed scene; 0 is the finest. One number for all, or one for each, as in 3,2."""
    crop: Annotated[tuple[float, ...] | None, readers.BOX, hint("no crop")] = None
    """Keep the Gaussians whose center lies in this box, in the frame of the scenes as they are."""
    min_opacity: Annotated[float, readers.OPACITY] = 0.0
    """Drop Gaussians fainter than this."""
    sh_degree: Annotated[int, readers.SH_DEGREE] = 3
    """Highest degree of spherical harmonics that is kept."""
    placement: Placement = Placement()
    compact: Flag = False
    """Round an SPZ as other encoders do: a quarter to two fifths smaller, several dB worse."""
    ksplat_compression: Annotated[int | None, readers.COMPRESSION, hint("1")] = None
    """Compression of a .ksplat: 0 whole floats, 1 half floats, 2 also a byte for each SH coefficient."""
    max_memory: Memory = None
    """Memory limit, such as 4GB: work that needs more is refused. A .ply is written batch by batch and fits."""
    overwrite: Overwrite = False
    output: Reading = Reading()


@dataclass(frozen=True, kw_only=True)
class Search:
    """How a scene is searched for what can go: `gsvis.edit.CleanConfig`."""

    strength: Annotated[float, readers.STRENGTH] = 1.0
    """How readily fog and floaters are found, above 0 to 2."""
    eyes: Annotated[int, readers.COUNTED] = 40
    """Number of eyes in navigable space that look all around."""
    held_out: Annotated[int, readers.WHOLE] = 8
    """Number of further views to measure on: the guard draws them before and after; 0 for none."""
    min_psnr: Annotated[float, readers.DECIBELS] = 45.0
    """Least PSNR of such a view when flyaways, interior and unseen go; else a class is given back."""
    max_changed: Annotated[float, readers.SHARE] = 0.1
    """Largest share of the pixels of these views that fog or floaters may have made; else the class is given back."""
    seed: Seed = 0


@dataclass(frozen=True)
class Clean:
    """Remove what no eye sees, fog, floaters and flyaways; without -o only report."""

    scene: Scene
    out: Annotated[str | None, out("OUT", "(default: only report)")] = None
    """File to write, .ply, .compressed.ply, .spz, .sog or .ksplat."""
    lod: Lod = None
    report: Annotated[str | None, hint("no report", "DIR")] = None
    """Report to write: a folder for report.html (all in one file), report.json and pictures of what goes, by class."""
    select: Annotated[str | None, hint("no file", "FILE")] = None
    """Write the class of each Gaussian: 0 stays, 1 flyaways, 2 interior, 3 unseen, 4 fog, 5 floaters."""
    apply: Annotated[str | None, hint("look for what can go", "FILE")] = None
    """Remove what an earlier --select, perhaps edited since, says; nothing is looked for."""
    classes: Annotated[tuple[str, ...] | None, readers.NAMES, hint("all")] = None
    """Classes that go: flyaways, interior, unseen, fog, floaters."""
    search: Search = Search()
    where: Annotated[
        Shown,
        with_help(
            {"cameras": "none"},
            cameras="Cameras of the capture, in the frame of SCENE: a COLMAP model, transforms.json or cameras.json."
            " They are eyes, too.",
        ),
    ] = Shown()
    max_memory: Memory = None
    """Memory limit, such as 2GB. A scene that needs more is cleaned in tiles, to a .ply; a killed run resumes."""
    overwrite: Overwrite = False
    output: Reading = Reading()


@dataclass(frozen=True, kw_only=True)
class Looking:
    """How eyes look, and what is measured: `gsvis.edit.CutConfig`."""

    tau: Annotated[float, readers.TAU, hint("1/255")] = 1.0 / 255.0
    """Weight from which a Gaussian counts as visible."""
    limit: Annotated[float, readers.SHARE] = 0.0015
    """The set that is kept is finished when rays prove that it misses at most this share of the light."""
    face_size: FaceSize = None
    held_out: Annotated[int, readers.WHOLE] = 16
    """Number of further views to measure on in one round; 0 for none."""
    min_psnr: Annotated[float, readers.DECIBELS] = 45.0
    """Least PSNR of such a view; one below it gets what it lacks, and others are drawn."""
    seed: Seed = 0


@dataclass(frozen=True)
class Cut:
    """Keep only what eyes along a path, of cameras or in a box can see."""

    scene: Scene
    out: Annotated[str, out("FILE")]
    """The scene to write, .ply, .compressed.ply, .spz, .sog or .ksplat. An existing file needs --overwrite."""
    lod: Lod = None
    where: Annotated[
        Placed,
        with_help(
            cameras="Cameras whose views are kept: a COLMAP model, transforms.json, cameras.json, or report.json of"
            " gsvis analyze. With --margin eyes may lie so far beside them."
        ),
    ] = Placed()
    fov: Annotated[float | None, readers.DEGREES, hint("eyes look all around")] = None
    """Horizontal field of view of the frames of --path: only what they show is kept."""
    from_outside: Flag = False
    """Cut the space open, so that eyes outside see into it: what stands in their way goes, such as the ceiling. Eyes
    inside are those of --path or --box, or anywhere in the scene's own rooms."""
    open_to: Annotated[tuple[float, float, float] | None, readers.POINT, hint("up")] = None
    """Direction in which the eyes outside are, with --from-outside; 1 1 1 opens a corner."""
    looking: Looking = Looking()
    select: File = None
    """Write what is kept as a NumPy file too: one true or false for each Gaussian of SCENE."""
    overwrite: Overwrite = False
    output: Reading = Reading()


@dataclass(frozen=True)
class Paint:
    """Color a scene by how its Gaussians are seen, for any viewer."""

    scene: Scene
    out: Annotated[str, out("FILE")]
    """The scene to write, .ply, .compressed.ply, .spz, .sog or .ksplat. Its legend goes beside it:
    scene.legend.png. Existing files need --overwrite."""
    by: Annotated[Literal["visibility", "directions", "weight", "importance", "cell"], readers.PLAIN] = "visibility"
    """visibility: share of the eyes that see it; directions: of 80, from how many; weight: largest share of a pixel;
    importance: change of views without it; cell: the cell that sees it best. (default: visibility)"""
    lod: Lod = None
    pvs: Annotated[str | None, hint("eyes are drawn", "FILE")] = None
    """Visible sets of SCENE (gsvis pvs), to take the quantity from; not for importance."""
    where: Annotated[Placed, with_help(up=f"{UP}; not with --pvs.")] = Placed()
    eyes: Annotated[Count, hint("64; for importance 96")] = None
    """Number of eyes that look all around; for importance, of views."""
    face_size: FaceSize = None
    values: File = None
    """Write the quantity as a NumPy file too: one number for each Gaussian."""
    seed: Seed = 0
    overwrite: Overwrite = False
    output: Reading = Reading()
