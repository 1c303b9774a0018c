"""Find where eyes may be in a scene by the strongest evidence: what a user states, cameras, a stated box, the scene.

Scene frame and units. Knows no files: cameras and a walk are given as they are.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from gsvis.errors import ArgumentError, SceneError
from gsvis.scene.axes import describe_direction, snap_to_axis
from gsvis.scene.cameras import Cameras
from gsvis.scene.corridor import corridor, space_walked
from gsvis.scene.flyaways import find_flyaways
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.kinds import KINDS
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.paths import HeadPath
from gsvis.scene.retarget import retarget
from gsvis.scene.solid import buried
from gsvis.scene.source import Source
from gsvis.scene.source_frame import SourceFrame
from gsvis.scene.upright import SURE, Upright, doubt_up, find_up
from gsvis.scene.witnesses import Witnesses, hold_out

__all__ = ["Evidence", "Place", "PlaceConfig", "find_place", "remark_on_flyaways"]

_BOX_VOXELS = 96  # along the longest side of a box
_TRIED = 256  # eyes tested for lying inside something solid


@dataclass(frozen=True, kw_only=True)
class PlaceConfig:
    """What a user states about where eyes are.

    Attributes:
        box: Low and high corner of a box, six numbers in the frame of the file; None for none.
        around: Center and radius of a ball around an object, four numbers; empty for the whole scene, None for none.
        kind: "object", "rooms" or "open-place"; None or "auto" leaves that to the evidence.
        margin: Largest distance of eyes from the walk, scene units; None is three voxels.
        retarget: Move the walk into the scene by a similarity transform.
        walk_name: Name of the walk in messages.
        cameras_name: Name of the cameras in messages.
        decided_by: What a user can state where the place is in doubt.
    """

    box: tuple[float, ...] | None = None
    around: tuple[float, ...] | None = None
    kind: str | None = None
    margin: float | None = None
    retarget: bool = False
    walk_name: str = "given"
    cameras_name: str = "the photos"
    decided_by: str = "a kind, an up axis, cameras, a box or a walk"

    @property
    def states_kind(self) -> bool:
        """Whether the kind of the scene is stated."""
        return self.kind not in (None, "auto")


@dataclass(frozen=True)
class Evidence:
    """The strongest evidence of where people stand.

    Attributes:
        source: Its origin, the strongest first: cameras, a walk, a box, a center or a kind given, the scene.
        confidence: In (0, 1]; 1 for what is given.
        text: What the scene was taken for, and why, in one line.
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
        path: The walk, moved into the scene if that was asked for; None without.
        cameras: The cameras given, which are eyes for checks too; None without.
        upright: Which way is up, and why.
        evidence: The evidence of where people stand; None without a space.
        decided_by: What a user can state where the place is in doubt.
    """

    space: NavigableSpace | None
    why_not: str
    remarks: list[str]
    path: HeadPath | None = None
    cameras: Cameras | None = None
    upright: Upright | None = None
    evidence: Evidence | None = None
    decided_by: str = PlaceConfig.decided_by

    @property
    def doubt(self) -> str:
        """One line if the kind or the up axis is uncertain, with what decides it; empty if both are certain."""
        if self.evidence is None:
            return ""
        parts = []
        if self.evidence.confidence < SURE:
            taken = self.evidence.text.split(":")[0]
            parts.append(f"the scene was taken for {taken} with a confidence of {self.evidence.confidence:.0%}")
        if self.upright is not None and not self.upright.sure:
            direction = describe_direction(self.upright.up)
            parts.append(f"up was taken for {direction} with a confidence of {self.upright.confidence:.0%}")
        return f"Not sure: {', and '.join(parts)}; {self.decided_by} decides." if parts else ""

    def required(self, remedy: str) -> NavigableSpace:
        """Return the navigable space.

        Raises:
            SceneError: If there is none; the message ends with the remedy.
        """
        if self.space is None:
            raise SceneError(f"{self.why_not}; {remedy}")
        return self.space


def find_place(
    source: Source,
    config: PlaceConfig | None = None,
    *,
    up: ArrayLike | None = None,
    walk: HeadPath | None = None,
    cameras: Cameras | None = None,
) -> Place:
    """Find where eyes may be, by the strongest evidence: stated by a user, cameras, a stated box, the scene itself.

    A user may state a walk, a box, a center or a kind; cameras then say which way is up, and are eyes of checks.

    Args:
        source: The scene.
        config: What the user states; nothing by default.
        up: (3,) up axis; None means the known one, else that of the cameras, else the likely one.
        walk: Walk that eyes are restricted to, in the frame of the file.
        cameras: Cameras that took photographs of the scene, in its frame.

    Raises:
        SceneError: If eyes in the box or around the object have no room; the problem begins with "box" or "around".
        ArgumentError: If the walk lies elsewhere; its name is "walk".
    """
    config = config or PlaceConfig()
    walk = None if walk is None else SourceFrame.from_scene(source.gaussians).walk(walk)
    upright, doubts = _upright(source, None if up is None else np.asarray(up, np.float64), cameras)
    far = remark_on_flyaways(source.gaussians) if config.box is None else []  # nothing outside of a box counts
    found = _find(source, config, upright, walk, cameras)
    found = replace(found, remarks=[*far, *doubts, *found.remarks])
    if found.space is None:
        return found
    evidence = found.evidence or _weigh(found.space, config, walk, cameras)
    space = replace(found.space, witnesses=_witnesses(config, walk, cameras, evidence))
    found = replace(
        found, space=space, upright=upright, cameras=cameras, evidence=evidence, decided_by=config.decided_by
    )
    more = [found.doubt] if found.doubt else []
    contradiction = space.kind.doubt
    if contradiction and evidence.confidence >= SURE:  # of cameras or a walk, which are evidence all the same
        more.append(f"{contradiction[:1].upper()}{contradiction[1:]}.")
    return replace(found, remarks=[*found.remarks, *more])


def _find(
    source: Source, config: PlaceConfig, upright: Upright, walk: HeadPath | None, cameras: Cameras | None
) -> Place:
    """Return the place that the strongest evidence gives."""
    if config.box is not None:
        return _in_box(source, config.box, upright)
    if config.around is not None:
        return _around(source, config.around, upright)
    if config.states_kind:
        return _of_kind(source, str(config.kind), upright)
    in_frame = walk is not None and not config.retarget
    if walk is not None and in_frame:
        _check_frame(source, walk)
    seeds = walk.positions if walk is not None and in_frame else None if cameras is None else cameras.viewpoints
    if seeds is not None:
        seeds = seeds[hold_out(len(seeds))[0]]
    axis = upright.up if upright.sure else None  # of an uncertain axis the space makes its own, wary choice
    remarks: list[str] = []
    found, why_not = source.navigable(up=axis, seeds=seeds)
    if source.gaussians.facts.box is not None and found is not None and found.kind.kind != "given" and seeds is None:
        remarks.append("Nothing in the box that the scene states is free; eyes are where the scene has them.")
    if found is None and seeds is not None:
        found, without = source.navigable(up=axis)
        if found is not None and walk is None:
            remarks.append(f"The cameras contradict the scene ({why_not}); eyes are where the scene has them.")
            return Place(found, "", remarks, evidence=_weigh(found, config, None, None))
        why_not = without
    if found is None:
        return Place(None, f"{source.path or source.name}: {why_not}", remarks)
    return Place(found, "", remarks) if walk is None else _along(source, found, config, walk, remarks)


def _in_box(source: Source, box: tuple[float, ...], upright: Upright) -> Place:
    """Return the place in a box, with a remark if many eyes in it lie inside something solid.

    Raises:
        SceneError: If all do.
    """
    low, high = SourceFrame.from_scene(source.gaussians).points([box[:3], box[3:]])
    space = NavigableSpace.from_box(low, high, _BOX_VOXELS, up=upright.up)
    eyes = space.sample_viewpoints(_TRIED, np.random.default_rng(0))
    lost = float(buried(source.union, eyes).mean())
    if lost == 1.0:
        raise SceneError(
            f"box: expected room for eyes, got a place in which all of {_TRIED} eyes drawn lie inside something solid",
            "give another, or a larger one",
        )
    solid = f"{lost:.0%} of the eyes in the box lie inside something solid and are left out."
    return Place(space, "", [solid] if lost > 0.5 else [])


def _around(source: Source, around: tuple[float, ...], upright: Upright) -> Place:
    """Return the place around an object, or around the whole scene.

    Raises:
        SceneError: If there is no room.
    """
    center = None
    radius = None
    if around:
        center = SourceFrame.from_scene(source.gaussians).points([around[:3]])[0]
        radius = around[3]
    try:
        return Place(NavigableSpace.around(source.gaussians, center, radius, up=upright.up), "", [])
    except SceneError as error:
        raise SceneError(f"around: {error.problem}", "give another center or radius") from None


def _of_kind(source: Source, kind: str, upright: Upright) -> Place:
    """Return the place in a scene whose kind is stated."""
    named = KINDS[kind]
    try:
        space = NavigableSpace.of_kind(source.gaussians, named, up=upright.up if upright.sure else None)
    except SceneError as error:
        return Place(None, f"{source.path or source.name}: kind {kind}: {error.problem}", [])
    return Place(space, "", [], evidence=Evidence("kind", 1.0, f"{named}: as stated"))


def _upright(source: Source, given: ArrayLike | None, cameras: Cameras | None) -> tuple[Upright, list[str]]:
    """Return which way is up, and a remark if something clearly contradicts what is stated."""
    known = source.known_up if given is None else np.asarray(given, np.float64)
    if known is None:
        likely = find_up(source.union, cameras=cameras, check=False)
        return replace(likely, up=snap_to_axis(likely.up)), []
    found = Upright(known, 1.0, "known" if given is None else "given by --up")
    if given is None and source.path is None:
        return found, []
    doubt = doubt_up(source.gaussians, known, cameras=cameras)
    return found, [f"Check the up axis: {doubt}"] if doubt else []


def _weigh(space: NavigableSpace, config: PlaceConfig, walk: HeadPath | None, cameras: Cameras | None) -> Evidence:
    """Return the evidence that decided where eyes are."""
    if walk is not None:
        return Evidence("walk", 1.0, f"along the walk {config.walk_name}")
    if config.box is not None:
        return Evidence("box", 1.0, "a box given by hand")
    if config.around is not None:
        return Evidence("around", 1.0, "around an object given by hand")
    if cameras is not None:
        return Evidence("cameras", max(space.kind.confidence, SURE), f"around {len(cameras):,} cameras")
    if space.kind.kind == "given":
        return Evidence("box", 1.0, space.kind.reason)
    return Evidence("scene", space.kind.confidence, f"{space.kind.kind}: {space.kind.reason}")


def _witnesses(
    config: PlaceConfig, walk: HeadPath | None, cameras: Cameras | None, evidence: Evidence
) -> Witnesses | None:
    """Return the cameras or poses of a walk that can judge: those that the space was not found by."""
    if cameras is not None:
        kept = np.arange(len(cameras)) if evidence.source != "cameras" else hold_out(len(cameras))[1]
        text = f"{len(kept):,} of the {len(cameras):,} cameras of {config.cameras_name}"
        return Witnesses(cameras[kept], text) if len(kept) else None
    if walk is None or config.retarget:
        return None
    kept = hold_out(len(walk))[1]
    text = f"{len(kept):,} of the {len(walk):,} poses of {config.walk_name}"
    return Witnesses(walk.cameras(64, 48)[kept], text) if len(kept) else None


def _check_frame(source: Source, walk: HeadPath) -> None:
    """Raise if most of a walk lies far from the scene: then it is in another frame, and says nothing of this one."""
    g = source.gaussians
    low, high = g.bounds(0.98)
    reach = float(np.linalg.norm(high - low)) + 3.0 * float(np.quantile(g.scales.max(axis=1), 0.98))
    near = np.all((walk.positions >= low - reach) & (walk.positions <= high + reach), axis=1)
    if near.mean() < 0.5:
        problem = f"expected a walk in the scene, got {near.mean():.0%} of its positions near it"
        raise ArgumentError("walk", problem, "retarget brings it there")


def remark_on_flyaways(g: Gaussians) -> list[str]:
    """Return a remark on Gaussians that lie too far outside to count; empty if there are none."""
    count = int(np.count_nonzero(find_flyaways(g.means, g.scales, g.opacities)))
    if not count:
        return []
    return [
        f"{count:,} Gaussians, {count / len(g):.1%} of all, lie far outside of the scene and do not count for where"
        " eyes may be; gsvis clean removes them."
    ]


def _along(source: Source, space: NavigableSpace, config: PlaceConfig, walk: HeadPath, remarks: list[str]) -> Place:
    """Return the space near a walk, with more remarks. A walk in the scene's frame is evidence that its eyes are free.

    Raises:
        ArgumentError: If the walk lies elsewhere.
    """
    if config.retarget:
        moved = retarget(walk, space)
        text = (
            f"The path was brought into the scene: {moved.rule}; scaled by {moved.similarity.scale:.3g};"
            f" {moved.inside:.0%} of it inside."
        )
        try:
            near = corridor(space, moved.path.positions, config.margin)
        except ValueError as error:
            raise ArgumentError("walk", str(error)) from None
        return Place(near, "", [*remarks, text], moved.path)
    some = walk.positions[:: max(1, len(walk) // _TRIED)]
    solid = float(buried(source.union, some).mean())
    if solid > 0.0:
        remarks = [
            *remarks,
            f"{solid:.0%} of the walk {config.walk_name} leads through something solid; its eyes count as free all the"
            " same.",
        ]
    try:
        near = space_walked(space, walk.positions[hold_out(len(walk))[0]], config.margin)
    except ValueError as error:
        raise ArgumentError("walk", str(error), "retarget brings it there") from None
    return Place(near, "", remarks, walk)
