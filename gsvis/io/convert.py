"""Convert scenes as `gsvis convert` does: merge, crop, drop faint Gaussians, reduce the SH degree, move.

Functions take and return scenes in their own frame; they know no file and no format.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis import _check
from gsvis.errors import SceneError
from gsvis.io._origin import place_scene
from gsvis.io.losses import report_loss
from gsvis.scene.facts import SceneFacts
from gsvis.scene.gaussians import Gaussians

__all__ = ["AXES", "convert_scene", "merge_scenes", "report_merge", "rotation_about_axes", "rotation_between_axes"]

AXES = ("+x", "-x", "+y", "-y", "+z", "-z")
"""Names of the six directions along the axes."""


def convert_scene(
    scene: Gaussians,
    *,
    crop: ArrayLike | None = None,
    min_opacity: float = 0.0,
    max_sh_degree: int = 3,
    up: tuple[str, str] | None = None,
    scale: float = 1.0,
    rotate: ArrayLike = (0.0, 0.0, 0.0),
    translate: ArrayLike = (0.0, 0.0, 0.0),
) -> Gaussians:
    """Return a new scene with fewer Gaussians, a lower SH degree, or a new placement.

    The order is fixed: `crop`, `min_opacity` and `max_sh_degree` in the frame of `scene`, then `up`, `scale`, `rotate`
    and `translate`, each in the frame that results from the steps before. Shapes and view-dependent colors are moved
    along. Rotation and scale are about (0, 0, 0) of the scene's source, in double precision.

    Args:
        scene: The scene; it is not modified.
        crop: (2, 3) lowest and highest corner of a box in the coordinates of the scene's source; keeps Gaussians whose
            center lies in it, borders included. Infinite coordinates leave a side open.
        min_opacity: Keep Gaussians of at least this opacity, in [0, 1].
        max_sh_degree: Drop higher degrees of the spherical harmonics, 0 to 3.
        up: The current up axis and the new one, such as `("-y", "+z")`. The scene rotates about the axis normal to
            both (by half a turn about x, or y for x itself, if they are opposite). None: no rotation.
        scale: New units per old unit, > 0.
        rotate: (3,) degrees about the x, y and z axis, in this order, about the origin; see `rotation_about_axes`.
        translate: (3,) in the new scene units.

    Returns:
        The converted scene, in the same order.

    Raises:
        ValueError: If an argument is out of its range, or places a Gaussian beyond the range of float32.
        SceneError: If no Gaussian is left.
    """
    if not 0.0 <= min_opacity <= 1.0:
        raise ValueError(f"min_opacity: expected a value in [0, 1], got {min_opacity!r}")
    if isinstance(max_sh_degree, bool) or max_sh_degree not in (0, 1, 2, 3):
        raise ValueError(f"max_sh_degree: expected 0, 1, 2 or 3, got {max_sh_degree!r}")
    if isinstance(scale, bool) or not (0.0 < scale < np.inf):  # also catches NaN
        raise ValueError(f"scale: expected a finite number above 0, got {scale!r}")
    rotation = np.eye(3) if up is None else rotation_between_axes(*_pair(up))
    rotation = rotation_about_axes(rotate) @ rotation
    shift = _check.floats("translate", translate, (3,), np.float64)
    kept = scene.opacities >= min_opacity
    if crop is not None:
        box = _check.floats("crop", crop, (2, 3), np.float64, finite=False)
        if not (box[0] <= box[1]).all():  # also catches NaN
            raise ValueError(f"crop: expected a lowest corner below the highest, got {box.tolist()}")
        places = scene.facts.to_source(scene.means) if any(scene.facts.origin) else scene.means
        kept &= ((places >= box[0]) & (places <= box[1])).all(axis=1)
    if not kept.any():
        raise SceneError(
            f"convert: crop and min_opacity {min_opacity:g} leave none of {len(scene):,} Gaussians; {_extent(scene)}"
        )
    result = scene if kept.all() else scene[kept]
    if result.sh_degree > max_sh_degree:
        higher = result.shN[:, : (max_sh_degree + 1) ** 2 - 1]
        g = result
        result = Gaussians(g.means, g.quats, g.scales, g.opacities, g.sh0, higher, facts=g.facts)
    if scale != 1.0 or shift.any() or not np.array_equal(rotation, np.eye(3)):
        _check_reach(result, scale, shift)
        result = place_scene(result, rotation, shift, scale)
    return result if up is None else result.with_facts(_with_up(result.facts, up[1], rotate))


def _with_up(facts: SceneFacts, axis: str, rotate: ArrayLike) -> SceneFacts:
    """Return facts that state the new up axis of `convert_scene`."""
    x, y, z = (rotation_about_axes(rotate) @ _axis("up", axis) + 0.0).tolist()
    return replace(facts, up=(x, y, z), up_source="convert --change-up")


def merge_scenes(scenes: Sequence[Gaussians]) -> Gaussians:
    """Return one scene with the Gaussians of all scenes, in their order; all must be in the same frame.

    Scenes with different origins get the origin of the largest one. Facts that differ between scenes are dropped; the
    log has a line for each that affects images.

    Args:
        scenes: At least one. The highest SH degree wins; the coefficients of the others are padded with zeros.

    Raises:
        ValueError: If `scenes` is empty.
    """
    if len(scenes) == 0:
        raise ValueError("scenes: expected at least one, got none")
    if len(scenes) == 1:
        return scenes[0]
    report_merge([scene.facts for scene in scenes])
    return Gaussians.concatenate(list(scenes))


def report_merge(facts: Sequence[SceneFacts]) -> None:
    """Log which facts a merged scene cannot state."""
    if len({each.antialiased for each in facts}) > 1:
        text = "some of the scenes are antialiased and some are not; the flag is lost"
        report_loss("merged scene", "antialiased", text)
    if len({each.up for each in facts}) > 1:
        report_loss(
            "merged scene", "up axis", "the scenes state different up axes, or some state none; the axis is lost"
        )


def rotation_about_axes(degrees: ArrayLike) -> NDArray[np.float64]:
    """Return the (3, 3) rotation by three angles: about x, then about y, then about z, axes that stay fixed.

    Args:
        degrees: (3,) angles; positive ones turn y to z, z to x, and x to y. Quarter turns are exact.

    Raises:
        ValueError: If they are not three finite numbers.

    Example:
        >>> (rotation_about_axes((90, 0, 90)) @ [0, 1, 0]).tolist()
        [0.0, 0.0, 1.0]
    """
    turn = np.eye(3)
    for axis, angle in enumerate(_check.floats("rotate", degrees, (3,), np.float64).tolist()):
        c = _cosine(angle)
        s = _cosine(angle - 90.0)
        about = np.eye(3)
        i = (axis + 1) % 3
        j = (axis + 2) % 3
        about[i, i] = c
        about[i, j] = -s
        about[j, i] = s
        about[j, j] = c
        turn = about @ turn
    return turn + 0.0  # converts -0.0 to 0.0


def rotation_between_axes(old: str, new: str) -> NDArray[np.float64]:
    """Return the (3, 3) rotation, new frame from old frame, that takes one axis to another.

    Args:
        old: One of `AXES`.
        new: One of `AXES`.

    Raises:
        ValueError: If a name is not in `AXES`.

    Example:
        >>> (rotation_between_axes("-y", "+z") @ [0, -1, 0]).tolist()
        [0.0, 0.0, 1.0]
    """
    a = _axis("up", old)
    b = _axis("up", new)
    if np.array_equal(a, b):
        return np.eye(3)
    if np.array_equal(a, -b):
        pivot = np.eye(3)[1 if a[0] else 0]
        return 2.0 * np.outer(pivot, pivot) - np.eye(3)
    normal = np.cross(a, b)
    turn = np.outer(b, a) - np.outer(a, b) + np.outer(normal, normal)
    return np.asarray(turn + 0.0, np.float64)  # + 0.0 converts -0.0 to 0.0


def _pair(up: object) -> tuple[str, str]:
    """Return the two checked axes of `up`."""
    if not isinstance(up, tuple | list) or len(up) != 2:
        raise ValueError(f'up: expected two axes, old and new, such as ("-y", "+z"), got {up!r}')
    return up[0], up[1]


def _axis(name: str, axis: str) -> NDArray[np.float64]:
    """Return the unit vector of an axis name."""
    _check.one_of(name, axis, AXES)
    return np.asarray(np.eye(3)["xyz".index(axis[1])] * (1.0 if axis[0] == "+" else -1.0), np.float64)


def _cosine(degrees: float) -> float:
    """Return the cosine of degrees, exactly for whole quarter turns."""
    quarters, rest = divmod(degrees, 90.0)
    if rest == 0.0:
        return (1.0, 0.0, -1.0, 0.0)[int(quarters % 4)]
    return float(np.cos(np.radians(degrees % 360.0)))


def _check_reach(scene: Gaussians, scale: float, shift: NDArray[np.float64]) -> None:
    """Raise if a placed scene would leave the range of float32."""
    reach = max(float(np.abs(scene.means).max()) * np.sqrt(3.0), float(scene.scales.max())) * scale
    reach += float(np.abs(shift).max())
    if not reach < np.finfo(np.float32).max:
        raise ValueError(f"scale, translate: expected a scene within 3.4e38 units, got one that reaches {reach:.3g}")


def _extent(scene: Gaussians) -> str:
    """Return the extent of the centers and opacities of a scene, for an error message."""
    if len(scene) == 0:
        return "the scene is empty"
    low, high = (np.round(scene.facts.to_source(corner), 3).tolist() for corner in scene.bounds())
    return f"98% of the centers lie in {low} to {high}, opacities reach {scene.opacities.max():.3g}"
