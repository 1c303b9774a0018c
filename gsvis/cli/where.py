"""Where eyes may be: found by the kind of the scene, or given by hand; with warnings about what they see."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from gsvis.cli.options import Framed, Placed, Shown, Where, refuse
from gsvis.cli.source import Source, file_cameras, framed_cameras, navigable_space, parse_up
from gsvis.cli.targets import check_exists, check_show
from gsvis.errors import FormatError, SceneError
from gsvis.io.poses import load_path
from gsvis.scene.axes import describe_direction, snap_to_axis
from gsvis.scene.cameras import Cameras
from gsvis.scene.corridor import corridor, space_walked
from gsvis.scene.flyaways import find_flyaways
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.kinds import KINDS
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.paths import HeadPath
from gsvis.scene.solid import buried
from gsvis.scene.source_frame import SourceFrame
from gsvis.scene.upright import SURE, Upright, doubt_up, find_up
from gsvis.scene.witnesses import Witnesses, hold_out

__all__ = [
    "Evidence",
    "Place",
    "check_cameras",
    "check_where",
    "evidence_cameras",
    "find_place",
    "flyaway_remarks",
    "kind_row",
    "space_document",
    "suspect_views",
]

_BOX_VOXELS = 96  # along the longest side of a box
_TRIED = 256  # eyes tested for lying inside something solid
_LOOKS = 8
_WIDTH = 96
_HEIGHT = 72
_LEAST_SEEN = 0.01  # share of the Gaussians
_LEAST_LIGHT = 0.05  # mean alpha of a view that does not look into the void
_VISIBLE = 1.0 / 255.0
_NOMINAL = (640, 480)  # pixels of cameras whose sizes differ
_CLOSE = 0.01  # of the scene's diagonal: views that end within it look into one surface


_DECIDE = "--kind, --up, --cameras, --box, --around or --path decides"


@dataclass(frozen=True)
class Evidence:
    """What says where people stand: the strongest that there is.

    Attributes:
        source: Where it comes from, the strongest first: cameras, a walk, a box, a center or a kind given, the scene.
        confidence: In (0, 1]; 1 for what is given.
        text: What was taken for what, in a line.
    """

    source: Literal["cameras", "walk", "box", "around", "kind", "scene"]
    confidence: float
    text: str


@dataclass(frozen=True, eq=False)
class Place:
    """Where eyes may be.

    Attributes:
        space: The navigable space; None if there is none.
        why_not: Why there is none; else empty.
        remarks: Remarks for the user.
        path: The walk of --path, brought into the scene if --retarget is given; None without.
        cameras: The cameras given, which are eyes for checks too; None without.
        upright: Which way is up, and why.
        evidence: What says where people stand; None without a space.
    """

    space: NavigableSpace | None
    why_not: str
    remarks: list[str]
    path: HeadPath | None = None
    cameras: Cameras | None = None
    upright: Upright | None = None
    evidence: Evidence | None = None

    @property
    def doubt(self) -> str:
        """One line where the kind or the up axis is uncertain, with what decides it; empty if both are sure."""
        return "" if self.evidence is None else _doubt(self.evidence, self.upright)

    def required(self, remedy: str) -> NavigableSpace:
        """Return the navigable space.

        Raises:
            SceneError: If there is none; the message ends with the remedy.
        """
        if self.space is None:
            raise SceneError(f"{self.why_not}; {remedy}")
        return self.space


def check_where(where: Where, other: str = "") -> HeadPath | None:
    """Check the options before work begins; return the walk of --path.

    Args:
        where: The options.
        other: An option that was given and says itself where eyes are, such as "--cameras".

    Raises:
        ValueError: If they contradict each other.
        FormatError: If the walk cannot be read.
    """
    if isinstance(where, Placed):
        parse_up(where.up)
    if isinstance(where, Shown):
        check_show(where.show)
    for name in ("margin", "retarget"):
        if getattr(where, name) and where.path is None:
            raise ValueError(f"--{name}: expected --path with it, got none; add it or leave this out")
    names = where.given
    if names and other:
        raise ValueError(f"--{names[0]}: expected none with {other}, which says where eyes are; leave one out")
    if where.kind not in (None, "auto") and (other or names):
        refuse(where, ["kind"], f"with {other or f'--{names[0]}'}, which says where eyes are")
    refuse(where, names[1:], f"with --{names[0] if names else ''}")
    check_cameras(where)
    return None if where.path is None else load_path(where.path)


def check_cameras(where: Framed) -> None:
    """Check --cameras and --cameras-frame before work begins.

    Raises:
        ValueError: If a frame is given without cameras.
        FileNotFoundError: If there is no file of cameras.
    """
    if where.cameras is None and where.cameras_frame != "auto":
        got = where.cameras_frame
        raise ValueError(f"--cameras-frame: expected --cameras with it, got {got} alone; leave it out")
    check_exists(where.cameras)


def find_place(
    source: Source,
    where: Where,
    walk: HeadPath | None = None,
    cameras: Cameras | None = None,
) -> Place:
    """Find where eyes may be, by the strongest evidence: given by hand, cameras, a stated box, then the scene itself.

    Given by hand are --path, --box, --around and --kind; cameras then say which way is up, and are eyes of checks.

    Args:
        source: The scene.
        where: What the user said. Without --up it is the known one, else that of cameras, else the likely one.
        walk: The walk of --path.
        cameras: Cameras that took photos of the scene; those of --cameras by default.

    Raises:
        SceneError: If eyes given by hand lie inside something solid.
        ValueError: If the walk lies elsewhere.
    """
    frame = SourceFrame.from_scene(source.gaussians)
    walk = None if walk is None else frame.walk(walk)
    framed: list[str] = []
    if cameras is None and (cameras := evidence_cameras(where)) is not None:
        cameras, framed = framed_cameras(source, cameras, where)
    upright, doubts = _upright(source, where.up if isinstance(where, Placed) else None, cameras)
    far = flyaway_remarks(source.gaussians) if where.box is None else []  # nothing outside of a box counts
    remarks = [*far, *framed, *doubts]
    found = _find(source, where, frame, upright, walk, cameras, remarks)
    if found.space is None:
        return found
    evidence = found.evidence or _weigh(found.space, where, cameras)
    assert found.space is not None
    witnesses = _witnesses(where, walk, cameras, evidence)
    space = replace(found.space, witnesses=witnesses)
    found = replace(found, space=space, upright=upright, cameras=cameras, evidence=evidence)
    more = [f" {found.doubt}"] if found.doubt else []
    contradiction = space.kind.doubt
    if contradiction and evidence.confidence >= SURE:  # of cameras or a walk, which are evidence all the same
        more.append(f" {contradiction[:1].upper()}{contradiction[1:]}.")
    return replace(found, remarks=[*found.remarks, *more])


def evidence_cameras(where: Framed) -> Cameras | None:
    """Return the cameras of --cameras; None without.

    Raises:
        FormatError: If the file cannot be read.
        FileNotFoundError: If there is no file.
        ValueError: If it holds no camera.
    """
    if where.cameras is None:
        return None
    try:
        return file_cameras(where.cameras, None, None)
    except FormatError:
        return file_cameras(where.cameras, *_NOMINAL)  # of several sizes, which do not matter here; else it fails again


def _find(
    source: Source,
    where: Where,
    frame: SourceFrame,
    upright: Upright,
    walk: HeadPath | None,
    cameras: Cameras | None,
    remarks: list[str],
) -> Place:
    """Return the place that the strongest evidence gives."""
    if where.box is not None:
        low, high = frame.points([where.box[:3], where.box[3:]])
        space = NavigableSpace.from_box(low, high, _BOX_VOXELS, up=upright.up)
        return Place(space, "", [*remarks, *_check_buried(source, space, "box")])
    if where.around is not None:
        center = None
        radius = None
        if where.around:
            center = frame.points([where.around[:3]])[0]
            radius = where.around[3]
        try:
            space = NavigableSpace.around(source.gaussians, center, radius, up=upright.up)
        except SceneError as error:
            raise SceneError(f"--around: {error.problem}; give another center or radius") from None
        return Place(space, "", remarks)
    if where.kind not in (None, "auto"):
        return _stated(source, where, upright, remarks)
    in_frame = walk is not None and not where.retarget
    if walk is not None and in_frame:
        _check_frame(source, where, walk)
    seeds = walk.positions if walk is not None and in_frame else None if cameras is None else cameras.viewpoints
    if seeds is not None:
        seeds = seeds[hold_out(len(seeds))[0]]
    axis = upright.up if upright.sure else None  # of an uncertain axis the space makes its own, wary choice
    found, why_not = navigable_space(source, up=axis, seeds=seeds)
    if source.gaussians.facts.box is not None and found is not None and found.kind.kind != "given" and seeds is None:
        remarks = [*remarks, " Nothing in the box that the scene states is free; eyes are where the scene has them."]
    if found is None and seeds is not None:
        found, without = navigable_space(source, up=axis)
        if found is not None and walk is None:
            more = f" The cameras contradict the scene ({why_not}); eyes are where the scene has them."
            return Place(found, "", [*remarks, more], evidence=_weigh(found, where, None))
        why_not = without
    if found is None:
        return Place(None, f"{source.path or source.name}: {why_not}", remarks)
    if walk is None:
        return Place(found, "", remarks)
    return _along(source, found, where, walk, remarks)


def _stated(source: Source, where: Where, upright: Upright, remarks: list[str]) -> Place:
    """Return the place in a scene whose kind is stated."""
    assert where.kind is not None
    up = upright.up if upright.sure else None
    kind = KINDS[where.kind]
    try:
        space = NavigableSpace.of_kind(source.gaussians, kind, up=up)
    except SceneError as error:
        return Place(None, f"{source.path or source.name}: --kind {where.kind}: {error.problem}", remarks)
    return Place(space, "", remarks, evidence=Evidence("kind", 1.0, f"{kind}: as stated"))


def _upright(source: Source, up: str | None, cameras: Cameras | None) -> tuple[Upright, list[str]]:
    """Return which way is up, and a remark if something clearly contradicts what is stated."""
    given = parse_up(up)
    known = source.known_up if given is None else given
    if known is None:
        likely = find_up(source.union, cameras=cameras, check=False)
        return replace(likely, up=snap_to_axis(likely.up)), []
    found = Upright(known, 1.0, "given by --up" if given is not None else "known")
    if given is None and source.path is None:
        return found, []
    doubt = doubt_up(source.gaussians, known, cameras=cameras)
    return found, [f" Check the up axis: {doubt}"] if doubt else []


def _weigh(space: NavigableSpace, where: Where, cameras: Cameras | None) -> Evidence:
    """Return what decided where eyes are."""
    if where.path is not None:
        return Evidence("walk", 1.0, f"along the walk {where.path}")
    if where.box is not None:
        return Evidence("box", 1.0, "a box given by hand")
    if where.around is not None:
        return Evidence("around", 1.0, "around an object given by hand")
    if cameras is not None:
        return Evidence("cameras", max(space.kind.confidence, SURE), f"around {len(cameras):,} cameras")
    if space.kind.kind == "given":
        return Evidence("box", 1.0, space.kind.reason)
    return Evidence("scene", space.kind.confidence, f"{space.kind.kind}: {space.kind.reason}")


def _witnesses(where: Where, walk: HeadPath | None, cameras: Cameras | None, evidence: Evidence) -> Witnesses | None:
    """Return who stood in the scene and can judge: cameras or a walk, without those that the space was found by."""
    if cameras is not None:
        kept = np.arange(len(cameras)) if evidence.source != "cameras" else hold_out(len(cameras))[1]
        what = f"{len(kept):,} of the {len(cameras):,} cameras of {where.cameras or 'the photos'}"
        return Witnesses(cameras[kept], what) if len(kept) else None
    if walk is None or where.retarget:
        return None
    kept = hold_out(len(walk))[1]
    poses = walk.cameras(64, 48)[kept] if len(kept) else None
    return None if poses is None else Witnesses(poses, f"{len(kept):,} of the {len(walk):,} poses of {where.path}")


def _doubt(evidence: Evidence, upright: Upright | None) -> str:
    parts = []
    if evidence.confidence < SURE:
        parts.append(
            f"the scene was taken for {evidence.text.split(':')[0]} with a confidence of {evidence.confidence:.0%}"
        )
    if upright is not None and not upright.sure:
        parts.append(f"up was taken for {describe_direction(upright.up)} with a confidence of {upright.confidence:.0%}")
    return f"Not sure: {', and '.join(parts)}; {_DECIDE}." if parts else ""


def _check_frame(source: Source, where: Where, walk: HeadPath) -> None:
    """Raise if most of a walk lies far from the scene: then it is in another frame, and says nothing of this one."""
    g = source.gaussians
    low, high = g.bounds(0.98)
    reach = float(np.linalg.norm(high - low)) + 3.0 * float(np.quantile(g.scales.max(axis=1), 0.98))
    near = np.all((walk.positions >= low - reach) & (walk.positions <= high + reach), axis=1)
    if near.mean() < 0.5:
        raise ValueError(
            f"--path {where.path}: expected a walk in the scene, got {near.mean():.0%} of its positions near it;"
            " --retarget brings it there"
        )


def flyaway_remarks(g: Gaussians) -> list[str]:
    """Return a remark on Gaussians that lie too far outside to count, if they are many."""
    count = int(np.count_nonzero(find_flyaways(g.means, g.scales, g.opacities)))
    if not count:
        return []
    return [
        f" {count:,} Gaussians, {count / len(g):.1%} of all, lie far outside of the scene and do not count for where"
        " eyes may be; gsvis clean removes them."
    ]


def _along(source: Source, space: NavigableSpace, where: Where, walk: HeadPath, remarks: list[str]) -> Place:
    """Return the space near a walk, with more remarks. A walk in the scene's frame is evidence that its eyes are free.

    Raises:
        ValueError: If the walk lies elsewhere.
    """
    remarks = [*remarks]
    if where.retarget:
        from gsvis.scene.retarget import retarget

        moved = retarget(walk, space)
        remarks.append(
            f" The path was brought into the scene: {moved.rule}; scaled by {moved.similarity.scale:.3g};"
            f" {moved.inside:.0%} of it inside."
        )
        try:
            return Place(corridor(space, moved.path.positions, where.margin), "", remarks, moved.path)
        except ValueError as error:
            raise ValueError(f"--path {where.path}: {error}") from None
    some = walk.positions[:: max(1, len(walk) // _TRIED)]
    solid = float(buried(source.union, some).mean())
    if solid > 0.0:
        remarks.append(
            f" {solid:.0%} of the walk {where.path} leads through something solid; its eyes count as free all the same."
        )
    try:
        return Place(space_walked(space, walk.positions[hold_out(len(walk))[0]], where.margin), "", remarks, walk)
    except ValueError as error:
        raise ValueError(f"--path {where.path}: {error}; --retarget brings it there") from None


def _check_buried(source: Source, space: NavigableSpace, option: str) -> list[str]:
    """Return a remark if many eyes lie inside something solid; raise if all do."""
    eyes = space.sample_viewpoints(_TRIED, np.random.default_rng(0))
    lost = float(buried(source.union, eyes).mean())
    if lost == 1.0:
        raise SceneError(
            f"--{option}: expected room for eyes, got a place in which all of {_TRIED} eyes drawn lie inside something"
            " solid; give another, or a larger one"
        )
    return [f" {lost:.0%} of the eyes in --{option} lie inside something solid and are left out."] if lost > 0.5 else []


def suspect_views(g: Gaussians, space: NavigableSpace) -> list[str]:
    """Return a remark for each way in which what eyes see is implausible; empty if nothing is.

    Args:
        g: The scene.
        space: Where eyes may be; a few views are drawn in it.
    """
    from gsvis.render import rasterize
    from gsvis.render.weights import view_weights
    from gsvis.scene.view_sampling import ViewSampling

    try:
        cameras = ViewSampling(_LOOKS, _WIDTH, _HEIGHT, 90.0).cameras(g, space)
    except SceneError as error:
        return [f" What eyes see is implausible: {error}."]
    seen = float((view_weights(g, cameras).largest >= _VISIBLE).mean())
    drawn = rasterize(g, cameras, backend="cpu", sh_degree=0)
    light = drawn.alphas.reshape(_LOOKS, -1).mean(axis=1)
    depth = np.median(drawn.depths.reshape(_LOOKS, -1), axis=1)
    diagonal = float(np.linalg.norm(np.subtract(*g.bounds(0.98)[::-1])))
    remedy = "; say where eyes belong with --box, --around or --path"
    found = []
    if seen < _LEAST_SEEN:
        found.append(f" Implausible: a view sees {seen:.2%} of the Gaussians on average{remedy}.")
    if np.mean(light < _LEAST_LIGHT) >= 0.5:
        found.append(f" Implausible: {np.mean(light < _LEAST_LIGHT):.0%} of the views look into the void{remedy}.")
    close = (light > 0.9) & (depth < _CLOSE * diagonal)
    if np.mean(close) >= 0.5:
        found.append(f" Implausible: {np.mean(close):.0%} of the views look into one surface{remedy}.")
    return found


def kind_row(space: NavigableSpace) -> tuple[str, str]:
    """Return a row of a table: what the scene is, and why."""
    return "taken for", str(space.kind)


def space_document(space: NavigableSpace) -> dict[str, Any]:
    """Return where eyes may be, for JSON."""
    return {
        "rule": space.rule,
        "voxel_size": space.voxel_size,
        "volume": space.volume,
        "kind": space.kind.as_dict(),
    }
