"""Certify a visible set by rays: bound the share of light that it misses, from rays that its build never used.

Rays start at free points of a cell that lie in nothing solid, drawn afresh, and run in uniform directions, save those
in which nothing can lie. The missed light is the weight of Gaussians outside the set over the weight of all Gaussians,
both in the mean over such rays. Scene frame and units.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsvis import _check
from gsvis.pvs.aim import Aim
from gsvis.pvs.bound import staged_bound, upper_bound
from gsvis.pvs.viewpoints import FreeVoxels
from gsvis.raycast import TAU, Tracer
from gsvis.scene.solid import Solid

__all__ = [
    "HEAVY",
    "Certificate",
    "CertificateConfig",
    "Certifier",
    "DrawRays",
    "heaviest_hits",
]

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

DrawRays = Callable[[int, np.random.Generator], tuple[F64, F64] | None]
"""Draws so many independent rays: origins (R, 3) and unit directions (R, 3); None if it cannot."""

HEAVY = 0.01
"""Weight from which a ray counts as one that misses much."""

_RAYS = 3  # random stream of a cell; see `quality.py` for the others
_AIM_SIZE = 64  # pixels along a side of the faces on which directions are marked
_TRIES = 32  # draws of origins until enough lie outside everything solid
_DIRECTION_BITS = 3  # bits of each coordinate of a direction in the order of tracing


@dataclass(frozen=True, kw_only=True)
class CertificateConfig:
    """Options of a certificate.

    Attributes:
        limit: Rounds end when the bound is at most this share, or the estimate is above it. 0 uses all rays.
        rays: Most rays of a cell.
        round_rays: Rays of a round.
        sparse: Largest factor on the numbers of rays if few rays meet something, because such rays cost little and
            prove nothing.
        error: Probability in (0, 1) that the bound is too low.
        checked: Rays of a cell that `cross_check` traces a second time; 0 for none.
        worst: Number of rays that are kept because they miss most.
        tau: Weight from which a missed Gaussian is listed.
        seed: Random seed of the rays.
    """

    limit: float = 0.0015
    rays: int = 8192
    round_rays: int = 2048
    sparse: int = 1
    error: float = 0.05
    checked: int = 64
    worst: int = 16
    tau: float = TAU
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("rays", "round_rays", "sparse"):
            _check.positive_int(name, getattr(self, name))
        for name in ("checked", "worst", "seed"):
            _check.positive_int(name, getattr(self, name), at_least=0)
        for name, low, high in (("limit", 0.0, 1.0), ("error", 1e-12, 0.5), ("tau", 1e-6, 0.5)):
            if not low <= getattr(self, name) <= high:
                raise ValueError(f"{name}: expected a value in [{low:g}, {high:g}], got {getattr(self, name)!r}")


@dataclass(frozen=True, eq=False)
class Certificate:
    """The light that the set of one cell misses, by R random rays.

    Attributes:
        cell: Number of the cell.
        error: Probability that the bound is too low.
        rounds: Rounds of rays.
        bound: Upper confidence bound of the missed light; see `upper_bound`.
        missed_weights: (R,) weight that the set misses on each ray.
        weights: (R,) weight of all Gaussians on each ray.
        worst_o: (W, 3) origins of the rays that miss most, most first; rays that miss nothing are left out.
        worst_d: (W, 3) unit directions of these rays.
        worst_missed: (W,) weight that the set misses on them.
        ids: (M,) missed Gaussians that have a weight of at least tau on some ray, ascending.
        id_weights: (M,) their largest weights.
        id_origins: (M, 3) origins of the rays with these weights.
        checked_o: (K, 3) origins of the rays for `cross_check`.
        checked_d: (K, 3) their unit directions.
    """

    cell: int
    error: float
    rounds: int
    bound: float
    missed_weights: F64
    weights: F64
    worst_o: F64
    worst_d: F64
    worst_missed: F64
    ids: I64
    id_weights: F32
    id_origins: F64
    checked_o: F64
    checked_d: F64

    def __len__(self) -> int:
        return len(self.weights)

    def __repr__(self) -> str:
        return f"Certificate(cell {self.cell}: {self.missed:.4%} missed, at most {self.bound:.4%}, {len(self):,} rays)"

    @property
    def missed(self) -> float:
        """Estimated share of the light that the set misses; 0 where no ray meets anything."""
        whole = float(self.weights.sum())
        return float(self.missed_weights.sum()) / whole if whole else 0.0

    @property
    def heavy(self) -> float:
        """Share of the rays that miss a weight of more than a hundredth."""
        return float(np.mean(self.missed_weights > HEAVY))

    def as_dict(self) -> dict[str, Any]:
        """Return the figures and the worst ray as plain numbers and lists for JSON."""
        worst = None
        if len(self.worst_o):
            worst = {
                "origin": self.worst_o[0].tolist(),
                "direction": self.worst_d[0].tolist(),
                "missed": float(self.worst_missed[0]),
            }
        return {
            "rays": len(self),
            "missed": self.missed,
            "bound": self.bound,
            "heavy_rays": self.heavy,
            "missed_gaussians": len(self.ids),
            "worst_ray": worst,
        }


class Certifier:
    """A scene prepared for certificates.

    Args:
        tracer: The scene, N Gaussians.

    Attributes:
        tracer: The scene.
        solid: Gaussians that can hold a point inside.
    """

    def __init__(self, tracer: Tracer) -> None:
        self.tracer = tracer
        self.solid = Solid.from_scene(tracer.proxies.gaussians)
        self._near: tuple[FreeVoxels | None, Solid] = None, self.solid  # the last cell, and what is solid near it
        self._aim: tuple[FreeVoxels | None, Aim | None] = None, None  # the last cell, and where it may see something

    def buries(self, voxels: FreeVoxels, points: F64) -> NDArray[np.bool_]:
        """Return which points (P, 3) of a cell lie inside something solid."""
        if self._near[0] is not voxels:
            self._near = voxels, self.solid.near(*voxels.bounds())
        return self._near[1].buries(points)

    def aim(self, voxels: FreeVoxels) -> Aim:
        """Return the directions in which eyes of a cell may meet something."""
        if self._aim[0] is not voxels or self._aim[1] is None:
            self._aim = voxels, Aim.of_box(self.tracer, *voxels.bounds(), _AIM_SIZE)
        assert self._aim[1] is not None
        return self._aim[1]

    def certify(
        self,
        voxels: FreeVoxels,
        ids: ArrayLike,
        config: CertificateConfig | None = None,
        *,
        stage: int = 0,
        earlier: Sequence[Certificate] | None = None,
    ) -> Certificate | None:
        """Bound the light that the set of a cell misses, by rounds of fresh rays.

        The rays depend only on the seed, the cell, the stage and the round. The bound holds for a set that was chosen
        without these rays, so a set to which findings of a certificate were added needs a new stage.

        Args:
            voxels: Where eyes may be in the cell: `CellViewpoints.voxels`.
            ids: (V,) Gaussians of the set.
            config: Options; None means `CertificateConfig()`.
            stage: Number of the stage; each stage draws different rays.
            earlier: Certificates of the set as it was before, with fewer Gaussians, oldest first; see `staged_bound`.
                None if this is the only certificate of the cell: it may use the whole error.

        Returns:
            The certificate; None if too few points of the cell lie outside everything solid.

        Raises:
            ValueError: If an id is out of range.
        """
        aim = self.aim(voxels)

        def draw(count: int, rng: np.random.Generator) -> tuple[F64, F64] | None:
            """Return random rays of a cell; None if it has no free point."""
            origins = self._origins(voxels, count, rng)
            return None if origins is None else (origins, aim.draw(count, rng))

        return self.certify_rays(draw, ids, config, name=voxels.cell, stage=stage, earlier=earlier)

    def certify_rays(
        self,
        draw: DrawRays,
        ids: ArrayLike,
        config: CertificateConfig | None = None,
        *,
        name: int = 0,
        stage: int = 0,
        earlier: Sequence[Certificate] | None = None,
    ) -> Certificate | None:
        """Bound the light that a set misses on rays of any kind, such as those of the pixels of cameras.

        Args:
            draw: Draws the rays of a round from the random numbers it is given, and nothing else.
            ids: (V,) Gaussians of the set.
            config: Options; None means `CertificateConfig()`.
            name: Takes the place of the number of a cell; each name draws different rays.
            stage: As in `certify`.
            earlier: As in `certify`.

        Returns:
            The certificate; None if `draw` returns None.

        Raises:
            ValueError: If an id is out of range.
        """
        config = config or CertificateConfig()
        missing = np.ones(len(self.tracer.proxies.gaussians), bool)
        missing[self.tracer.check_ids(ids)] = False
        before = None if earlier is None else [(each.missed_weights, each.weights) for each in earlier]
        rounds: list[_Round] = []
        drawn = 0
        bound = 1.0
        factor = 1
        while drawn < factor * config.rays:
            count = min(factor * config.round_rays, factor * config.rays - drawn)
            rng = np.random.default_rng([config.seed, name, _RAYS, stage, len(rounds)])
            rays = draw(count, rng)
            if rays is None:
                return None
            rounds.append(_trace_round(self.tracer, missing, *rays))
            drawn += count
            missed = np.concatenate([each.missed for each in rounds])
            weights = np.concatenate([each.weights for each in rounds])
            factor = max(1, min(config.sparse, round(1.0 / max(float(weights.mean()), 1.0 / config.sparse))))
            if drawn < factor * min(config.round_rays, config.rays):
                continue
            if before is None:
                bound = upper_bound(missed, weights, error=config.error)
            else:
                bound = staged_bound([*before, (missed, weights)], error=config.error)
            hopeless = missed.sum() > config.limit * weights.sum()
            if config.limit and (hopeless or bound <= config.limit):
                break
        return _summarize(rounds, name, bound, config)

    def _origins(self, voxels: FreeVoxels, count: int, rng: np.random.Generator) -> F64 | None:
        """Return (count, 3) free points of a cell outside everything solid; None if too few are found."""
        found = np.zeros((0, 3))
        for _ in range(_TRIES):
            points = voxels.draw(count, rng)
            found = np.concatenate([found, points[~self.buries(voxels, points)]])
            if len(found) >= count:
                return found[:count]
        return None


@dataclass(frozen=True, eq=False)
class _Round:
    """R rays of one round, with the K hits of Gaussians that the set misses."""

    origins: F64
    directions: F64
    missed: F64  # (R,)
    weights: F64  # (R,)
    hit_ids: I64  # (K,)
    hit_weights: F32  # (K,)
    hit_origins: F64  # (K, 3)


def heaviest_hits(ids: I64, weights: F32) -> tuple[I64, I64]:
    """Return the distinct ids (M,) of some hits, ascending, and for each the number of its hit with most weight."""
    order = np.lexsort((-weights, ids))
    distinct, first = np.unique(ids[order], return_index=True)
    return distinct, order[first]


def _trace_round(tracer: Tracer, missing: NDArray[np.bool_], origins: F64, directions: F64) -> _Round:
    """Trace rays; `missing` (N,) marks the Gaussians outside the set."""
    count = len(origins)
    coarse = ((directions + 1.0) * 2 ** (_DIRECTION_BITS - 1)).astype(np.int64)
    order = np.lexsort(coarse.T)  # neighbors in sequence look the same way: their paths share memory
    hits = tracer.contributions(origins[order], directions[order])
    lost = missing[hits.gaussian_ids]
    rows = order[hits.ray_ids]
    weights = np.minimum(np.bincount(rows, hits.weights, count), 1.0)
    missed = np.minimum(np.bincount(rows[lost], hits.weights[lost], count), weights)
    hit_ids = hits.gaussian_ids[lost]
    hit_weights = hits.weights[lost]
    return _Round(origins, directions, missed, weights, hit_ids, hit_weights, origins[rows[lost]])


def _summarize(rounds: list[_Round], cell: int, bound: float, config: CertificateConfig) -> Certificate:
    """Return the certificate of rounds."""
    origins, directions, missed, weights, hit_ids, hit_weights, hit_origins = (
        np.concatenate([getattr(each, name) for each in rounds]) for name in _Round.__dataclass_fields__
    )
    worst = np.argsort(-missed, kind="stable")[: config.worst]
    worst = worst[missed[worst] > 0.0]
    ids, heaviest = heaviest_hits(hit_ids, hit_weights)
    largest = hit_weights[heaviest]
    listed = largest >= np.float32(config.tau)
    checked = slice(0, config.checked)
    return Certificate(
        cell=cell,
        error=config.error,
        rounds=len(rounds),
        bound=bound,
        missed_weights=missed,
        weights=weights,
        worst_o=origins[worst],
        worst_d=directions[worst],
        worst_missed=missed[worst],
        ids=ids[listed],
        id_weights=largest[listed],
        id_origins=hit_origins[heaviest][listed],
        checked_o=origins[checked],
        checked_d=directions[checked],
    )
