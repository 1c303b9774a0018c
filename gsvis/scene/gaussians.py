"""Define a scene: a frozen set of 3D Gaussians with activated values.

Frame and units are the scene's own (any handedness-preserving world frame). Quaternions are wxyz, scales are
standard deviations, opacities lie in [0, 1]. This module knows no file format, no camera and no renderer.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis import _check
from gsvis.scene.facts import SceneFacts
from gsvis.scene.flyaways import find_flyaways
from gsvis.scene.sh import rotation_of_sh, sh_degree_of

__all__ = ["Gaussians", "quats_from_rotations", "rotations_from_quats"]

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

_NOTHING_KNOWN = SceneFacts()
_LOG_SCALES = "did you pass log scales? pass np.exp(log_scales), or use gsvis.from_gsplat"
_LOGITS = "did you pass logits? pass 1 / (1 + np.exp(-logit_opacities)), or use gsvis.from_gsplat"
_FLAT = "give a flat Gaussian a small positive scale"
_TURN = "pass (1, 0, 0, 0) for no rotation"


@dataclass(frozen=True, init=False, eq=False, repr=False)
class Gaussians:
    """N 3D Gaussians, validated, read-only, activated.

    Contiguous float32 arrays are used without a copy: do not write to them afterward. Torch tensors are accepted
    from any device; those that require a gradient are copied.

    Args:
        means: (N, 3) centers, scene units.
        quats: (N, 4) rotations wxyz, any non-zero length; stored normalized.
        scales: (N, 3) standard deviations along the rotated axes, scene units, > 0.
        opacities: (N,) in [0, 1].
        sh0: (N, 1, 3) constant SH coefficient of each color channel (color = 0.5 + 0.28209 sh0).
        shN: (N, K-1, 3) higher SH coefficients, K in {1, 4, 9, 16}; None means degree 0.
        facts: Facts about the scene; none by default. Selections keep them.

    Raises:
        ValueError: If a shape, a length or a value is out of range; the message names the argument.

    Examples:
        >>> ball = Gaussians([[0, 0, 0]], [[1, 0, 0, 0]], [[1, 1, 2]], [0.5], [[[0, 0, 0]]])
        >>> ball
        Gaussians(1 of SH degree 0)
        >>> ball.transform(np.eye(3), translation=(1, 0, 0), scale=2.0).covars()[0].diagonal()
        array([ 4.,  4., 16.])
    """

    means: F32
    quats: F32
    scales: F32
    opacities: F32
    sh0: F32
    shN: F32  # noqa: N815  the field's own name
    facts: SceneFacts

    def __init__(
        self,
        means: ArrayLike,
        quats: ArrayLike,
        scales: ArrayLike,
        opacities: ArrayLike,
        sh0: ArrayLike,
        shN: ArrayLike | None = None,  # noqa: N803
        *,
        facts: SceneFacts = _NOTHING_KNOWN,
    ) -> None:
        arrays: dict[str, F32] = {
            "means": _check.floats("means", means, ("N", 3)),
            "quats": _check.floats("quats", quats, ("N", 4)),
            "scales": _check.floats("scales", scales, ("N", 3)),
            "opacities": _check.floats("opacities", opacities, ("N",)),
            "sh0": _check.floats("sh0", sh0, ("N", 1, 3)),
        }
        n = len(arrays["means"])
        arrays["shN"] = np.zeros((n, 0, 3), np.float32) if shN is None else _check.floats("shN", shN, ("N", "K-1", 3))
        _check.same_length(**arrays)
        sh_degree_of(1 + arrays["shN"].shape[1])
        negative = arrays["scales"].size and arrays["scales"].min() < 0.0
        _check.in_range(
            "scales", arrays["scales"], 0.0, np.inf, open_low=True, remedy=_LOG_SCALES if negative else _FLAT
        )
        _check.in_range("opacities", arrays["opacities"], 0.0, 1.0, remedy=_LOGITS)
        arrays["quats"] = _normalize(arrays["quats"])
        for name, array in arrays.items():
            view = array.view()
            view.flags.writeable = False
            object.__setattr__(self, name, view)
        object.__setattr__(self, "facts", facts)

    def with_facts(self, facts: SceneFacts) -> Gaussians:
        """Return the same Gaussians, not copied, with new facts."""
        same: Gaussians = object.__new__(type(self))
        for name in _NAMES:
            object.__setattr__(same, name, getattr(self, name))
        object.__setattr__(same, "facts", facts)
        return same

    def without_harmonics(self) -> Gaussians:
        """Return the same Gaussians, not copied, without SH above degree 0: for work that needs no colors."""
        same = self.with_facts(self.facts)
        none = np.zeros((len(self), 0, 3), np.float32)
        none.flags.writeable = False
        object.__setattr__(same, "shN", none)
        return same

    def showing(self, shown: NDArray[np.bool_]) -> Gaussians:
        """Return the same Gaussians, not copied, of which those outside a mask (N,) have no opacity.

        Images are those of a selection, which would copy all harmonics.

        Raises:
            ValueError: If the mask has another shape.
        """
        if shown.shape != (len(self),):
            raise ValueError(f"shown: expected shape ({len(self)},), got {shown.shape}")
        same = self.with_facts(self.facts)
        opacities = np.where(shown, self.opacities, np.float32(0.0))
        opacities.flags.writeable = False
        object.__setattr__(same, "opacities", opacities)
        return same

    def with_origin(self, origin: ArrayLike) -> Gaussians:
        """Return the same scene with centers relative to a new origin, moved in double precision.

        Args:
            origin: (3,) the new origin, in the coordinates of the scene's source.
        """
        facts = self.facts.shift(origin)
        if facts == self.facts:
            return self
        away = np.asarray(self.facts.origin) - np.asarray(facts.origin)
        means = (self.means.astype(np.float64) + away).astype(np.float32)
        return Gaussians(means, self.quats, self.scales, self.opacities, self.sh0, self.shN, facts=facts)

    @classmethod
    def empty(cls, sh_degree: int = 0) -> Gaussians:
        """Return a scene without Gaussians."""
        z = np.zeros
        return cls(z((0, 3)), z((0, 4)), z((0, 3)), z(0), z((0, 1, 3)), z((0, (sh_degree + 1) ** 2 - 1, 3)))

    @classmethod
    def concatenate(cls, parts: list[Gaussians]) -> Gaussians:
        """Return one scene with the Gaussians of several; lower SH degrees are padded with zeros.

        Parts with different origins get the origin of the largest one. Facts on which all parts agree are kept.

        Raises:
            ValueError: If `parts` is empty.
        """
        if not parts:
            raise ValueError("parts: expected at least one scene, got none")
        origin = max(parts, key=len).facts.origin
        parts = [part.with_origin(origin) for part in parts]
        joined = {name: np.concatenate([getattr(part, name) for part in parts]) for name in _NAMES[:-1]}
        joined["quats"] = _normalize(joined["quats"])
        joined["shN"] = _join_harmonics([part.shN for part in parts])
        return cls._of_valid(joined, SceneFacts.merge([part.facts for part in parts]))

    @classmethod
    def _of_valid(cls, arrays: dict[str, F32], facts: SceneFacts) -> Gaussians:
        """Return Gaussians of contiguous arrays that were checked before; a second check would take long."""
        made: Gaussians = object.__new__(cls)
        for name, array in arrays.items():
            array.flags.writeable = False
            object.__setattr__(made, name, array)
        object.__setattr__(made, "facts", facts)
        return made

    def __len__(self) -> int:
        return len(self.means)

    def __getitem__(self, index: Any) -> Gaussians:
        """Select Gaussians by a slice, a boolean mask, an index array, or one integer (a scene of one)."""
        if isinstance(index, int | np.integer):
            index = np.asarray([index])
        if isinstance(index, tuple) or np.ndim(index) > 1:
            raise IndexError("index: expected a slice, a mask, an index array or an integer, got several dimensions")
        return self._of_valid({name: np.ascontiguousarray(getattr(self, name)[index]) for name in _NAMES}, self.facts)

    def __repr__(self) -> str:
        return f"Gaussians({len(self):,} of SH degree {self.sh_degree})"

    @property
    def sh_degree(self) -> int:
        """Degree of the SH coefficients, 0 to 3."""
        return sh_degree_of(1 + self.shN.shape[1])

    @property
    def nbytes(self) -> int:
        """Bytes held by the arrays."""
        return sum(int(getattr(self, name).nbytes) for name in _NAMES)

    def bounds(self, coverage: float = 0.98) -> F64:
        """Return an axis-aligned box with the middle `coverage` of the centers on each axis.

        Trained scenes have floaters thousands of scene sizes away, so extreme centers are useless. If `find_flyaways`
        finds more than 1% flyaways, the box ignores them first.

        Args:
            coverage: Share of the centers kept on each axis, in (0, 1]; 1 gives the exact box of all.

        Returns:
            (2, 3) float64, lowest and highest corner.

        Raises:
            ValueError: If the scene is empty or `coverage` is out of range.
        """
        if len(self) == 0:
            raise ValueError("bounds: expected at least one Gaussian, got an empty scene")
        if not 0.0 < coverage <= 1.0:
            raise ValueError(f"coverage: expected a value in (0, 1], got {coverage!r}")
        tail = (1.0 - coverage) / 2.0
        counted = self.means.astype(np.float64)
        if tail > 0.0 and (flown := find_flyaways(self.means, self.scales, self.opacities)).any():
            counted = counted[~flown]
        return np.asarray(np.quantile(counted, [tail, 1.0 - tail], axis=0))

    def rotations(self) -> F64:
        """Return (N, 3, 3) rotation matrices, world from Gaussian; columns are the principal axes."""
        return rotations_from_quats(self.quats)

    def covars(self) -> F64:
        """Return (N, 3, 3) covariances R diag(scales^2) R^T, scene units squared."""
        half = self.rotations() * self.scales.astype(np.float64)[:, None, :]
        return np.asarray(half @ np.swapaxes(half, 1, 2))

    def transform(self, rotation: ArrayLike, translation: ArrayLike = (0, 0, 0), scale: float = 1.0) -> Gaussians:
        """Return the same scene in a new frame, x -> scale * R x + t; view-dependent color is rotated too.

        Args:
            rotation: (3, 3) rotation, new frame from old frame.
            translation: (3,) in new scene units.
            scale: New units per old unit, > 0.

        Returns:
            A new scene of the same length and order.

        Raises:
            ValueError: If `rotation` is not a rotation or `scale` is not positive.
        """
        r = _check.floats("rotation", rotation, (3, 3), np.float64)
        t = _check.floats("translation", translation, (3,), np.float64)
        if not (np.isfinite(scale) and scale > 0):
            raise ValueError(f"scale: expected a finite number > 0, got {scale!r}")
        turn = rotation_of_sh(r, self.sh_degree)[1:, 1:]
        quats = _quat_product(quats_from_rotations(r[None])[0], self.quats.astype(np.float64))
        return Gaussians(
            scale * (self.means.astype(np.float64) @ r.T) + t,
            quats,
            np.maximum(self.scales.astype(np.float64) * scale, np.finfo(np.float32).tiny),
            self.opacities,
            self.sh0,
            np.einsum("ij,njc->nic", turn, self.shN) if turn.size else self.shN,
            facts=self.facts.transform(r, scale, t),
        )


_NAMES = tuple(f.name for f in fields(Gaussians) if f.name != "facts")


def _normalize(quats: F32) -> F32:
    """Return unit quaternions; raise if one is zero."""
    squared = np.einsum("ij,ij->i", quats, quats, dtype=np.float64)
    if len(squared) and squared.min() < 1e-24:
        zero = int(squared.argmin())
        raise ValueError(f"quats: expected non-zero quaternions, got a zero one at index {zero}; {_TURN}")
    if np.all(np.abs(squared - 1.0) < 2e-7):
        return quats
    scaled: F32 = (quats / np.sqrt(squared)[:, None]).astype(np.float32)
    return scaled


def _join_harmonics(parts: list[F32]) -> F32:
    """Return coefficients (N, K-1, 3) of several scenes; those of lower degrees are padded with zeros."""
    joined = np.zeros((sum(map(len, parts)), max(part.shape[1] for part in parts), 3), np.float32)
    first = 0
    for part in parts:
        joined[first : first + len(part), : part.shape[1]] = part
        first += len(part)
    return joined


def _quat_product(left: F64, right: F64) -> F64:
    """Return the Hamilton products of one quaternion (4,) with many (N, 4), wxyz."""
    w, x, y, z = left
    matrix = np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])
    return np.asarray(right @ matrix.T)


def rotations_from_quats(quats: NDArray[np.floating[Any]]) -> F64:
    """Return (N, 3, 3) rotation matrices of (N, 4) unit quaternions wxyz."""
    w, x, y, z = quats.astype(np.float64).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def quats_from_rotations(rotations: NDArray[np.floating[Any]]) -> F64:
    """Return (N, 4) unit quaternions wxyz, w >= 0, of (N, 3, 3) rotation matrices.

    References:
        Bar-Itzhack, "New method for extracting the quaternion from a rotation matrix", JGCD 2000.
    """
    m = rotations.astype(np.float64)
    k = np.empty((len(m), 4, 4))
    k[:, 0, 0] = m[:, 0, 0] + m[:, 1, 1] + m[:, 2, 2]
    k[:, 0, 1:] = np.stack([m[:, 2, 1] - m[:, 1, 2], m[:, 0, 2] - m[:, 2, 0], m[:, 1, 0] - m[:, 0, 1]], axis=1)
    k[:, 1:, 0] = k[:, 0, 1:]
    k[:, 1:, 1:] = m + np.swapaxes(m, 1, 2) - np.eye(3) * k[:, 0, 0][:, None, None]
    quats: F64 = np.linalg.eigh(k)[1][:, :, -1]
    return quats * np.where(quats[:, :1] < 0, -1.0, 1.0)
