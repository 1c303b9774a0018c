"""The options of the commands that make, check, export and serve packages; see `gsvis.cli.arguments`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from gsvis.cli import readers
from gsvis.cli.options import (
    IN_DOUBT,
    LISTENING,
    Cluster,
    Fit,
    Framed,
    Levels,
    Output,
    Placed,
    Reading,
    Sending,
    Sets,
    Shown,
    Work,
    with_help,
)
from gsvis.cli.readers import AsInPaper, Count, Device, Flag, Lod, Overwrite, Scene, Seed, Units, Up, hint, out

__all__ = ["Export", "Prepare", "Presented", "Serve", "Space", "Unpack", "Verify", "View", "World"]

_TABLES = "in GSVIS_CACHE, or in ~/.cache/gsvis"


@dataclass(frozen=True, kw_only=True)
class MendedSets(Sets):
    """How visible sets of a package are found."""

    certify: Annotated[int | None, readers.WHOLE, hint("8192")] = None
    """Largest number of random rays in each cell that bound the light its set misses; 0 for none: the set stays as the
    z-buffer and hidden points found it, the paper's way."""
    max_inner: Annotated[int | None, readers.WHOLE, hint("16")] = None
    """Largest number of times that a set is mended and certified again."""
    tracer: Annotated[Literal["hierarchy", "embree"], readers.PLAIN] = "hierarchy"
    """What traces rays. hierarchy: our own, over ellipsoids; embree: Open3D's Embree, over proxy meshes, many times
    slower. (default: hierarchy)"""


@dataclass(frozen=True, kw_only=True)
class FilteredFit(Fit):
    """How colors of a package are fitted, and which terms are sent."""

    precision: Annotated[Literal["wire", "coarse"], readers.PLAIN] = "wire"
    """Bits of colors and terms. coarse: a fifth fewer bytes of them, best where colors change smoothly with the view
    and many terms overlap, such as plants. (default: wire)"""
    record_psnr: Annotated[float, readers.DECIBELS] = 0.0
    """Round records as coarsely as images keep this PSNR against exact ones, and learn their colors again; 0 keeps all
    bits. 48 saves an eighth to two fifths of the bytes."""
    epsilon: Annotated[float | None, readers.EPSILON, hint("0.02")] = None
    """Smallest change of a color for which a term is sent; auto asks the metric FLIP what an eye would see."""
    cell_terms: Annotated[Literal["computed", "stored"], readers.PLAIN] = "computed"
    """Active terms of cells. computed: when they are needed; stored: listed in the package, the paper's way. (default:
    computed)"""


@dataclass(frozen=True, kw_only=True)
class Machine(Work):
    """The machine that works, and its GPU."""

    device: Device = "auto"
    """Device that draws and trains. auto: cuda where torch and gsplat can use a GPU here, else cpu. It trains levels
    and draws while colors are learned; all else runs on the CPU. (default: auto)"""


@dataclass(frozen=True)
class Prepare:
    """Make a package of a scene that can be served: levels, visible sets, colors."""

    scene: Scene
    """File or folder (.ply, .splat, .ksplat, .spz, .sog, .glb, .pt, .ckpt, lod-meta.json, levels) or builtin:NAME."""
    out: Annotated[str, out("DIR")]
    """Folder of the package, such as scene.gsvis; scene.gsvis.work beside it keeps work for the next run."""
    lod: Lod = None
    """Level of detail of a streamed scene to start from; 0 is the finest."""
    where: Annotated[Shown, with_help(show=IN_DOUBT)] = Shown()
    as_in_paper: AsInPaper = False
    training: Annotated[
        Levels,
        with_help(photos="Photographs to train levels and colors on, with the model that SCENE was trained from."),
    ] = Levels()
    sets: MendedSets = MendedSets()
    fit: FilteredFit = FilteredFit()
    color_steps: Annotated[int | None, readers.WHOLE, hint("300")] = None
    """Steps of learning, one view each: photographs, or renders of SCENE without --photos, kept if held-out renders
    gain; 0 keeps the fit."""
    meters_per_unit: Annotated[Units, hint("that of SCENE, or not known")] = None
    """Length of a scene unit in meters, kept in the package."""
    seed: Seed = 0
    work: Annotated[
        Machine,
        with_help(
            workers="Number of processes that find visible sets. The package is the same for any number.",
            dry_run="Print time, memory and disk of each stage, and write nothing.",
        ),
    ] = Machine()
    join_cells: Flag = False
    """Join cells until visible sets are about a fifth of the package: it is smaller, and first images come later."""
    discard: Flag = False
    """Delete what is kept for the next run, scene.gsvis.work, when the package is complete."""
    output: Reading = Reading()


@dataclass(frozen=True, kw_only=True)
class Tiling:
    """How a world is cut."""

    tile: Annotated[int, readers.COUNTED] = 250_000
    """Most Gaussians of a tile, about."""
    far: Annotated[int, readers.COUNTED] = 8_192
    """Most Gaussians of a district, which stands for one or several tiles from afar."""
    angle: Annotated[float, readers.RADIANS] = 0.006
    """Lower levels and districts stand in from where their spacing is below this angle."""
    levels: Annotated[tuple[float, ...], readers.SHARES_OR_NONE, hint("0.25 0.5")] = (0.25, 0.5)
    """Size of each lower level as a share of a tile's, lowest first; none for the tiles alone."""
    steps: Annotated[int, readers.STEPS] = 250
    """Steps of training for each lower level, one view each; fewer also look less at what may go."""


@dataclass(frozen=True, kw_only=True)
class TileSets(Sets):
    """How visible sets of tiles are found."""

    cells: Annotated[int, readers.CELLS] = 32
    """Largest number of cells of a tile."""


@dataclass(frozen=True, kw_only=True)
class Walked(Framed):
    """Where eyes of a world are, and which way is up."""

    path: Annotated[str | None, hint("no path", "FILE")] = None
    """Walk that viewpoints are restricted to, in the frame of the scenes: a CSV of poses (t,x,y,z,qw,qx,qy,qz) or an
    EyeNavGS recording. Tiles that it does not come near have no cells."""
    margin: Annotated[Units, hint("1")] = None
    """Distance of viewpoints from --path, at most, in scene units."""
    up: Up = None
    """Up in the scene: an axis such as -y, or three numbers. Tiles are cut along the axes that are nearest to level."""


@dataclass(frozen=True, kw_only=True)
class Tasks(Cluster):
    """The processes that make a world, and where results of tasks lie."""

    work: Annotated[str | None, hint("beside DIR", "DIR or URL")] = None
    """Where results of tasks lie: a shared folder or a URL of fsspec, such as s3://bucket/city."""


@dataclass(frozen=True)
class World:
    """Make a world of scenes of any size: tiles, each a package, and districts."""

    scenes: Annotated[Positional[tuple[str, ...]], readers.SCENES, readers.PLAIN]
    """Files or folders, as for gsvis convert, all in one frame; PLY or streamed SOG if they do not fit the memory."""
    out: Annotated[str, out("DIR")]
    """Folder of the world, such as city.gsworld; city.gsworld.work beside it keeps work for the next run."""
    lod: Annotated[tuple[int, ...] | None, readers.LODS, hint("the finest that is there")] = None
    """Level of detail of a streamed scene; 0 is the finest. One number for all, or one for each, as in 3,2."""
    tiling: Tiling = Tiling()
    sets: TileSets = TileSets()
    where: Annotated[
        Walked,
        with_help(
            cameras="Cameras of the capture, in the frame of the scenes: a COLMAP model, transforms.json or"
            " cameras.json. They say which way is up, eyes are around half of them too, and the others judge the sets"
            " of tiles.",
        ),
    ] = Walked()
    meters_per_unit: Annotated[Units, hint("that of the scenes, or not known")] = None
    """Length of a scene unit in meters, kept in the world."""
    seed: Seed = 0
    work: Annotated[
        Tasks,
        with_help(
            workers="Number of processes of this machine. The world is the same for any number.",
            scheduler="Dask scheduler whose workers do the work, such as tcp://10.0.0.5:8786. They must reach the"
            " scenes and --work.",
            dry_run="Print time, memory and disk, tiles and core hours, and write nothing.",
        ),
    ] = Tasks()
    until: Annotated[Literal["tiles", "levels", "world"], readers.PLAIN] = "world"
    """Stop early: tiles writes a PLY for each into DIR, levels a folder of levels, with tiles.json. (default: world)"""
    discard: Flag = False
    """Delete what is kept for the next run, city.gsworld.work, when the world is complete, but not what lies in
    --work."""
    output: Reading = Reading()


@dataclass(frozen=True)
class Verify:
    """Read, check and decode every part of a package, or of all packages of a world."""

    package: Annotated[Positional[str], arg(metavar="PACKAGE", help_behavior_hint="")]
    """Folder of a package, such as scene.gsvis, or of a world, such as city.gsworld."""
    scene: Annotated[str | None, hint("what gsvis prepare found", "SCENE")] = None
    """The scene from which it was made: measure how near what a client gets comes to it."""
    lod: Lod = None
    """Level of detail of a streamed --scene; 0 is the finest."""
    tables: Annotated[str | None, hint(_TABLES, "DIR OF KEPT TABLES")] = None
    """Folder for tables that gsvis serve keeps; those of the package are read too."""
    output: Reading = Reading()


@dataclass(frozen=True)
class Unpack:
    """Write a package back as one PLY for each level."""

    package: Annotated[Positional[str], arg(metavar="PACKAGE", help_behavior_hint="")]
    """Folder of a package, such as scene.gsvis."""
    out: Annotated[str, out("DIR")]
    """Folder for low.ply, ... and levels.arrow, the map of reuse; made if missing."""
    sh_degree: Annotated[int | None, readers.SH_DEGREE, hint("3, 0 where colors have no terms")] = None
    """Highest degree of spherical harmonics, which terms are fitted with; 0 keeps base colors alone."""
    output: Output = Output()


@dataclass(frozen=True, kw_only=True)
class Presented:
    """How the page of a site or of one file presents the scene."""

    title: Annotated[str | None, hint("the scene's name", "TITLE")] = None
    """Title of the page and of its preview in other pages."""
    settings: Annotated[str | None, hint("views that show much", "FILE")] = None
    """A settings.json of SuperSplat or of this page: views, hotspots, camera paths, background."""
    poster: Annotated[str | None, hint("none", "FILE")] = None
    """A picture that is shown until the scene is drawn."""
    backdrop: Annotated[str | None, hint("of the settings or theme", "COLOR")] = None
    """Color behind the scene, such as #20242c."""
    og_image: Annotated[str | None, hint("none", "FILE")] = None
    """A picture for previews in other pages, a file or an address; some of those pages need the address."""
    accent: Annotated[str | None, hint("blue", "COLOR")] = None
    """Color of the controls, such as #d4380d; made lighter or darker until it can be read."""
    visitor: Flag = False
    """Leave out what is for engineers: Inspect, counts, levels, cells."""
    language: Annotated[str | None, hint("of the visitor's browser", "LANG")] = None
    """Language of the page: en or de."""
    embedders: Annotated[tuple[str, ...], readers.ORIGINS, hint("its own")] = ()
    """Origins whose pages may ask for pictures and picks in a frame, such as https://blog.example; * is all."""
    page_origins: Annotated[tuple[str, ...], readers.ORIGINS, hint("its own address")] = ()
    """Other origins that a site may open scenes of, by ?content=, such as https://cdn.example.org; for static."""


@dataclass(frozen=True, kw_only=True)
class Tiled:
    """How 3D Tiles and glTF hold Gaussians."""

    compression: Annotated[Literal["auto", "none", "spz"], readers.PLAIN] = "auto"
    """How 3dtiles and glb hold Gaussians. none: every value as it is; spz: a fifth of the size, and what CesiumJS
    reads; auto: spz for 3dtiles, none for glb. (default: auto)"""
    request_volumes: Flag = False
    """Have viewers of 3dtiles request a tile only in the box of the cells that need it. From outside of all cells
    little is drawn then. Needs visible sets."""


@dataclass(frozen=True, kw_only=True)
class Lightened:
    """What a view of the written version may have at most."""

    budget_splats: Annotated[Count, hint("no limit")] = None
    """Write a lighter version: most Gaussians that a view of 90 degrees has, from every eye of the space."""
    budget_fill: Annotated[float | None, readers.FILL, hint("no limit")] = None
    """Write a lighter version: most Gaussians over a pixel, in the mean of a view of 90 degrees."""


@dataclass(frozen=True)
class Export:
    """Write a scene for players that need no gsvis: sites, streamed SOG, 3D Tiles."""

    scene: Scene
    """A package, or a scene as it is: a file or folder that gsvis reads, or builtin:NAME."""
    out: Annotated[str, out("OUT")]
    """Folder of the site, the streamed SOG or the tileset; or the .html, .glb or .usdz file, or a .ssog or .zip of the
    streamed SOG."""
    format: Annotated[Literal["static", "html", "streamed-sog", "3dtiles", "glb", "usd"], readers.PLAIN] = "static"
    """static: a site that any file server or CDN serves; html: one file that opens from disk; streamed-sog: leaves for
    PlayCanvas' engine, and which of them each cell needs; 3dtiles: a tileset for CesiumJS; glb: one file of glTF; usd:
    one file of OpenUSD. (default: static)"""
    pvs: Annotated[str | None, hint("those of a package", "FILE")] = None
    """Visible sets of SCENE (gsvis pvs), where it is no package; for streamed-sog and 3dtiles."""
    never_seen: Annotated[Literal["keep", "drop"], readers.PLAIN] = "keep"
    """What streamed-sog and 3dtiles do with Gaussians that no cell sees; from outside, holes show. (default: keep)"""
    leaf: Annotated[int | None, readers.LEAF, hint("8192")] = None
    """Most Gaussians of a leaf of streamed-sog or 3dtiles; leaves have half of it at least."""
    tiled: Tiled = Tiled()
    meters_per_unit: Annotated[Units, hint("the package's, or 1")] = None
    """Length of a scene unit in meters, for 3dtiles, glb and usd."""
    budget: Lightened = Lightened()
    name: Annotated[str | None, hint("--title, or that of SCENE", "NAME")] = None
    """Name of the scene in the page."""
    page: Presented = Presented()
    lod: Lod = None
    where: Annotated[
        Shown,
        with_help(
            {"up": "the package's, or the likely one"},
            show="Write a picture of where people stand: the first view, and a plan with eyes; for static and html.",
        ),
    ] = Shown()
    overwrite: Flag = False
    """Replace files that exist: a file, an earlier streamed SOG or tileset, or a page of something else. An earlier
    site is replaced without it."""
    output: Reading = Reading()


@dataclass(frozen=True)
class Space:
    """Write where a visitor can be, and what stops one, for other programs."""

    scene: Scene
    out: Annotated[str, out("OUT")]
    """OUT.glb: two meshes, navigable and surface. OUT.voxel.json, with OUT.voxel.bin: solid voxels as SuperSplat and
    PlayCanvas read them, in their frame."""
    lod: Lod = None
    where: Placed = Placed()
    resolution: Annotated[Count, hint("160")] = None
    """Voxels along the longest side of the scene, 8 to 384; not with --box, --around, --path."""
    frame: Annotated[Literal["upright", "scene"], readers.PLAIN] = "upright"
    """Frame of the meshes. upright: +y points upwards; scene: the frame of SCENE. (default: upright)"""
    meters_per_unit: Annotated[Units, hint("that of SCENE, or 1")] = None
    """Length of a scene unit in meters: upright meshes are in meters then."""
    overwrite: Overwrite = False
    output: Reading = Reading()


@dataclass(frozen=True)
class View:
    """Show a scene or a package in the browser, until Ctrl-C."""

    scene: Scene
    """A package, a world or a static scene, or a scene as it is: a file or folder, or builtin:NAME."""
    lod: Lod = None
    where: Annotated[Shown, with_help(up="Up in a scene as it is: an axis such as -y, or three numbers.")] = Shown()
    prepare: Annotated[str | None, hint("show it as it is", "PACKAGE")] = None
    """Also prepare the scene as this package meanwhile; it is served under the same name as soon as it is ready."""
    host: Annotated[str, hint("127.0.0.1", "HOST")] = "127.0.0.1"
    """Address to listen on. 127.0.0.1 accepts this machine only, 0.0.0.0 every machine."""
    port: Annotated[int | None, readers.PORT, hint("8765, or a free one")] = None
    """Port; 0 takes one that is free."""
    no_browser: Flag = False
    """Print the address and open no browser."""
    output: Annotated[Reading, LISTENING] = Reading()


@dataclass(frozen=True, kw_only=True)
class Address:
    """Where a server listens: `gsvis.serve.Address`."""

    host: Annotated[str, hint("127.0.0.1", "HOST")] = "127.0.0.1"
    """Address to listen on. 127.0.0.1 accepts this machine only, 0.0.0.0 every machine."""
    port: Annotated[int, readers.PORT] = 8765
    """Port; 0 takes one that is free."""
    ssl_certfile: Annotated[str | None, hint("no TLS", "FILE")] = None
    """Certificate chain (PEM) for TLS."""
    ssl_keyfile: Annotated[str | None, hint("in --ssl-certfile", "FILE")] = None
    """Its key (PEM)."""


@dataclass(frozen=True, kw_only=True)
class Access:
    """Who may connect: fields of `gsvis.serve.AppConfig`."""

    token: Annotated[str | None, hint("GSVIS_TOKEN, or none", "TOKEN")] = None
    """Token that clients must send. Other users of this machine can see this option: prefer the environment."""
    origins: Annotated[tuple[str, ...], readers.ORIGINS, hint("its own address")] = ()
    """Allow web pages of these origins, such as https://example.org; * allows every page."""
    page_origins: Annotated[tuple[str, ...], readers.ORIGINS, hint("its own address")] = ()
    """Other origins that the page may open scenes of, by ?content=, such as https://cdn.example.org; no token goes
    there."""
    hosts: Annotated[tuple[str, ...], readers.HOSTS, hint("--host")] = ()
    """Names under which the server is reached, such as stream.example.org; .example.org is all below, * every name."""
    proxies: Annotated[tuple[str, ...], readers.ADDRESSES, hint("none")] = ()
    """Addresses of trusted proxies, such as 127.0.0.1 or 10.0.0.0/8; the server believes their X-Forwarded-For."""


@dataclass(frozen=True, kw_only=True)
class Bounds:
    """What viewers may take: `gsvis.serve.Limits`."""

    clients: Annotated[int, readers.COUNTED] = 100
    """Most viewers at once."""
    per_address: Annotated[Count, hint("half of --clients, at least 8")] = None
    """Most viewers of one address at once, and most other connections of it."""
    messages: Annotated[int, readers.COUNTED] = 200
    """Most messages of a viewer a second, on average over ten seconds."""
    message_bytes: Annotated[int | None, readers.BYTES, hint("what holdings of the largest scene take")] = None
    """Longest message of a viewer, such as 1MB."""
    poses: Annotated[int, readers.COUNTED] = 60
    """Most poses of a viewer a second; the server ignores more."""
    handshake: Annotated[float, readers.SECONDS] = 10.0
    """Time limit from a connection to HELLO, seconds."""
    keep_alive: Annotated[float, readers.SECONDS] = 15.0
    """Time limit from an answer to the next request of a connection, seconds."""
    idle: Annotated[float, readers.SECONDS] = 60.0
    """Disconnect a viewer after so many seconds of silence."""
    stall: Annotated[float, readers.SECONDS] = 30.0
    """Disconnect a viewer that does not read for so many seconds."""
    close: Annotated[float, readers.SECONDS] = 600.0
    """Close a scene that nobody looks at for so many seconds; the next viewer opens it again."""
    tables_memory: Annotated[int, readers.BYTES, hint("800MB")] = 800_000_000
    """Memory limit for mapped tables, for each process."""


@dataclass(frozen=True)
class Serve:
    """Serve packages to viewers over WebSockets, until Ctrl-C."""

    package: Annotated[Positional[tuple[str, ...]], readers.PACKAGES, readers.PLAIN]
    """Folders of packages or worlds, such as scene.gsvis; each is served under its name, the first also without one."""
    address: Address = Address()
    access: Access = Access()
    as_in_paper: AsInPaper = False
    sending: Sending = Sending()
    coarse: Flag = False
    """Round records before they are sent: about 10 bytes a Gaussian instead of 14, at about 45 dB."""
    bounds: Bounds = Bounds()
    cache: Annotated[int, readers.BYTES, hint("512MB")] = 512_000_000
    """Memory limit for decoded cells, for each process."""
    tables: Annotated[str | None, hint(_TABLES, "DIR")] = None
    """Folder for tables that are computed once for each package and memory-mapped after that."""
    no_tables: Flag = False
    """Decode packages into memory at the start instead, and never close them."""
    workers: Annotated[int, readers.COUNTED] = 1
    """Number of processes that serve on the one port; as many as cores serve most viewers."""
    planners: Annotated[int, readers.WHOLE] = 0
    """Threads that plan what to send; 0 plans in the event loop."""
    log_format: Annotated[Literal["text", "json"], readers.PLAIN] = "text"
    """Form of the log on stderr: lines for people, or one JSON object a line. (default: text)"""
    output: Annotated[Output, LISTENING] = Output()
