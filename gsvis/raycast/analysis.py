"""Analyze a scene: what views need of it, and from how many directions its Gaussians are visible (paper, section 3.1).

Cameras are traced one at a time and only counters and direction sets are kept, so memory does not grow with their
number. World frame of the scene. Visible means a largest weight of at least tau (docs/conventions.md). Knows no file,
no plot and no command line.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, replace
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsvis import _check
from gsvis.errors import SceneError
from gsvis.progress import Progress, silent
from gsvis.raycast import TAU, CrossCheck, EllipsoidProxies, Tracer, cross_check, directions, visible_in
from gsvis.raycast.tracer import TRACERS
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.navigable import NavigableSpace

__all__ = ["FACE_LIMITS", "PAPER", "Agreement", "Analysis", "AnalysisConfig", "DirectionCdf", "Settling", "analyze"]

PAPER = MappingProxyType(
    {"mean_visible": 0.2021, "one_view_visible": 0.3358, "below_33_faces": 0.394, "below_48_faces": 0.804}
)
"""Results of SRBF-Gaussian, section 3.1, on Tanks & Temples: shares of all Gaussians, in [0, 1]."""

FACE_LIMITS = (33, 48)
"""41.25% and 60% of the 80 faces; the paper's shares are of Gaussians seen from *less* than these."""

SETTLED = 0.02
"""A CDF has settled if each point moves by less than this when the number of cameras doubles."""

_ANGLE_RAYS = 4  # rays per face for solid angles, which converge faster than faces (docs/results.md)
U8 = NDArray[np.uint8]
F64 = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class AnalysisConfig:
    """How to analyze a scene.

    Attributes:
        tau: Least weight of a visible Gaussian, in (0, 1].
        tracer: What traces the pixels of cameras: one of `TRACERS`. Directions outward are traced by our hierarchy.
        traced_sample: Number of random Gaussians whose directions are traced outward; 0 traces none.
        rays_per_face: Traced rays over each of the 80 faces: 1, 4, 16 or 64. A face counts if any part of it is
            seen, so more rays find more faces.
        checked_rays: Number of rays through random pixels that a second tracer traces again; 0 for none.
        seed: Seed of the sample, of the order of the cameras, and of these rays.
    """

    tau: float = TAU
    tracer: str = "hierarchy"
    traced_sample: int = 5000
    rays_per_face: int = 16
    checked_rays: int = 256
    seed: int = 0

    def __post_init__(self) -> None:
        if not 0.0 < self.tau <= 1.0:
            raise ValueError(f"tau: expected a weight in (0, 1], got {self.tau!r}")
        _check.one_of("tracer", self.tracer, TRACERS)
        _check.positive_int("traced_sample", self.traced_sample, at_least=0)
        for name in ("checked_rays", "seed"):
            _check.positive_int(name, getattr(self, name), at_least=0)
        if self.rays_per_face not in (1, 4, 16, 64):
            raise ValueError(f"rays_per_face: expected 1, 4, 16 or 64, got {self.rays_per_face!r}")


@dataclass(frozen=True, eq=False)
class DirectionCdf:
    """Distribution of the number of faces from which Gaussians are seen, of 80.

    Attributes:
        count: Number of Gaussians.
        values: (81,) float64; entry k is the share seen from at most k faces.
    """

    count: int
    values: F64

    @classmethod
    def from_sets(cls, sets: U8) -> DirectionCdf:
        """Return the distribution of direction sets (N, 10), N > 0."""
        return cls(len(sets), directions.direction_cdf(directions.direction_fractions(sets)))

    @property
    def seen(self) -> int:
        """Number of Gaussians seen from at least one face."""
        return round(self.count * (1.0 - float(self.values[0])))

    @property
    def values_of_seen(self) -> F64:
        """(81,) the same distribution over the Gaussians seen at least once; all 1 if there are none."""
        none = float(self.values[0])
        return np.asarray((self.values - none) / (1.0 - none)) if self.seen else np.ones_like(self.values)

    @property
    def mean_faces(self) -> float:
        """Mean number of faces from which a Gaussian is seen, over all Gaussians."""
        return float(np.sum(1.0 - self.values[:-1]))

    def below(self, faces: int, *, of_seen: bool = False) -> float:
        """Return the share of the Gaussians seen from strictly fewer than `faces` faces.

        Args:
            faces: 1 to 80.
            of_seen: Count only Gaussians seen at least once.
        """
        return float((self.values_of_seen if of_seen else self.values)[faces - 1])

    def as_dict(self) -> dict[str, Any]:
        """Return plain numbers and lists, ready for JSON."""
        return {
            "gaussians": self.count,
            "seen_at_least_once": self.seen,
            "mean_faces": self.mean_faces,
            "share_below": [
                {"faces": k, "of_all": self.below(k), "of_seen": self.below(k, of_seen=True)} for k in FACE_LIMITS
            ],
            "cdf_of_all": self.values.tolist(),
            "cdf_of_seen": self.values_of_seen.tolist(),
        }


@dataclass(frozen=True)
class Settling:
    """Figures after part of the cameras, which show whether more cameras would change the gathered directions.

    Attributes:
        cameras: Number of cameras so far, in a random order.
        seen: Number of Gaussians seen at least once by them.
        mean_faces: Mean number of faces from which a Gaussian is seen, over all Gaussians.
        below_33_of_all: Share of all Gaussians seen from fewer than 33 faces.
        below_48_of_all: Share of all Gaussians seen from fewer than 48 faces.
        below_33_of_seen: Share of the Gaussians seen at least once that are seen from fewer than 33 faces.
        below_48_of_seen: Share of the Gaussians seen at least once that are seen from fewer than 48 faces.
        change: Largest difference from the CDF of all Gaussians at the previous step; None for the first step.
    """

    cameras: int
    seen: int
    mean_faces: float
    below_33_of_all: float
    below_48_of_all: float
    below_33_of_seen: float
    below_48_of_seen: float
    change: float | None

    @classmethod
    def from_cdfs(cls, cameras: int, cdf: DirectionCdf, before: DirectionCdf | None) -> Settling:
        """Return the figures of a distribution, and its change since the previous step."""
        return cls(
            cameras=cameras,
            seen=cdf.seen,
            mean_faces=cdf.mean_faces,
            below_33_of_all=cdf.below(33),
            below_48_of_all=cdf.below(48),
            below_33_of_seen=cdf.below(33, of_seen=True),
            below_48_of_seen=cdf.below(48, of_seen=True),
            change=None if before is None else float(np.abs(cdf.values - before.values).max()),
        )


@dataclass(frozen=True)
class Agreement:
    """Agreement of the two kinds of direction sets over the traced sample.

    Attributes:
        mean_jaccard: Mean Jaccard index; 1 if both sets are empty.
        mean_jaccard_of_seen: Mean Jaccard index over the Gaussians in at least one of the sets.
        gathered_confirmed: Share of all faces gathered from cameras that tracing outward found too.
        traced_confirmed: Share of all faces traced outward that cameras saw too.
    """

    mean_jaccard: float
    mean_jaccard_of_seen: float
    gathered_confirmed: float
    traced_confirmed: float

    @classmethod
    def from_sets(cls, gathered: U8, traced: U8) -> Agreement:
        """Compare two direction sets (M, 10) of the same Gaussians, M > 0."""
        index = directions.jaccard(gathered, traced)
        either = (gathered | traced).any(axis=1)
        both, of_gathered, of_traced = (_faces(sets) for sets in (gathered & traced, gathered, traced))
        return cls(
            float(index.mean()),
            float(index[either].mean()) if either.any() else 1.0,
            both / of_gathered if of_gathered else 1.0,
            both / of_traced if of_traced else 1.0,
        )


@dataclass(frozen=True, eq=False)
class Analysis:
    """Result of `analyze`.

    Attributes:
        config: The configuration.
        gaussians: N, all Gaussians of the scene.
        opaque_enough: Number of Gaussians with an opacity of at least 1/255, so that they can be visible at all.
        cameras: The C cameras; visible fractions depend on their resolution and field of view.
        visible: (C,) int64, number of visible Gaussians in each camera.
        gathered_sets: (N, 10) uint8, direction sets gathered from the cameras.
        gathered: Distribution of `gathered_sets`.
        settling: Figures after 1/8, 1/4, 1/2 and all of the cameras.
        sample: (M,) int64, the Gaussians traced outward, ascending; empty without tracing.
        traced_sets: (M, 10) uint8, direction sets of the sample.
        traced: Distribution of `traced_sets`; None without tracing.
        agreement: Agreement of both kinds of sets over the sample; None without tracing.
        untraced_because: Why nothing was traced outward; empty otherwise.
        solid_angles: (M,) share of the sphere, by solid angle, from which each Gaussian of the sample is visible; None
            without tracing. It hardly changes with more rays.
        check: Agreement of two tracers on rays through random pixels; None without a second tracer or if
            `checked_rays` is 0.
    """

    config: AnalysisConfig
    gaussians: int
    opaque_enough: int
    cameras: Cameras
    visible: NDArray[np.int64]
    gathered_sets: U8
    gathered: DirectionCdf
    settling: tuple[Settling, ...]
    sample: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    traced_sets: U8 = field(default_factory=lambda: np.zeros((0, 10), np.uint8))
    traced: DirectionCdf | None = None
    agreement: Agreement | None = None
    untraced_because: str = ""
    solid_angles: NDArray[np.float32] | None = None
    check: CrossCheck | None = None

    def below_solid_angle(self, share: float) -> float:
        """Return the share of the traced Gaussians visible from less than this share of the sphere, by solid angle.

        Raises:
            ValueError: If nothing was traced outward.
        """
        if self.solid_angles is None:
            raise ValueError("solid_angles: expected directions traced outward, got none; give navigable space")
        return float(np.count_nonzero(self.solid_angles < share) / len(self.solid_angles))

    @property
    def visible_fractions(self) -> F64:
        """(C,) share of all Gaussians visible in each camera."""
        return self.visible / self.gaussians

    @property
    def field_of_view(self) -> tuple[float, float]:
        """Smallest and largest horizontal field of view of the cameras, degrees."""
        fx = self.cameras.Ks[:, 0, 0]
        cx = self.cameras.Ks[:, 0, 2]
        angles = np.degrees(np.arctan2(cx, fx) + np.arctan2(self.cameras.width - cx, fx))
        return float(angles.min()), float(angles.max())

    @property
    def has_settled(self) -> bool:
        """Whether twice the cameras moved no point of the gathered CDF by 2 percentage points or more.

        Each camera adds at most one face to a set. Fewer than 160 cameras therefore never count as settled: the first
        half must have been able to fill all 80 faces.
        """
        change = self.settling[-1].change
        return change is not None and self.settling[-2].cameras >= directions.NUM_FACES and change < SETTLED

    def as_dict(self) -> dict[str, Any]:
        """Return plain numbers, strings and lists, ready for JSON."""
        fractions = self.visible_fractions
        low, high = self.field_of_view
        return {
            "config": asdict(self.config),
            "gaussians": self.gaussians,
            "gaussians_of_opacity_1_255": self.opaque_enough,
            "rays": {"width": self.cameras.width, "height": self.cameras.height, "horizontal_fov_degrees": [low, high]},
            "visible_fraction": {
                "mean": float(fractions.mean()),
                "min": float(fractions.min()),
                "max": float(fractions.max()),
                "cameras": [
                    {"name": name, "visible": int(count), "fraction": float(fraction)}
                    for name, count, fraction in zip(self.cameras.names, self.visible, fractions, strict=True)
                ],
            },
            "directions": {
                "share_below_counts": "Gaussians seen from strictly fewer faces of the 80",
                "gathered": self.gathered.as_dict(),
                "settling": [asdict(step) for step in self.settling],
                "has_settled": self.has_settled,
                "traced": self.traced.as_dict() if self.traced else None,
                "solid_angle": self._solid_angle(),
                "untraced_because": self.untraced_because or None,
                "agreement": asdict(self.agreement) if self.agreement else None,
            },
            "traced_twice": None if self.check is None else asdict(self.check),
            "paper": dict(PAPER),
        }

    def _solid_angle(self) -> dict[str, Any] | None:
        """Return figures of the solid angles as plain numbers; None without tracing."""
        if self.solid_angles is None:
            return None
        shares = [{"share": k / 80.0, "of_all": self.below_solid_angle(k / 80.0)} for k in FACE_LIMITS]
        return {"mean": float(self.solid_angles.mean()), "share_below": shares}


def analyze(
    g: Gaussians,
    cameras: Cameras,
    config: AnalysisConfig | None = None,
    *,
    navigable: NavigableSpace | None = None,
    tracer: Tracer | None = None,
    progress: Progress = silent,
) -> Analysis:
    """Compute the visible fraction of each camera, and direction sets from the cameras and traced outward.

    Args:
        g: The scene, N Gaussians.
        cameras: C cameras; one ray through each pixel center.
        config: Thresholds, sample and seed; None means `AnalysisConfig()`.
        navigable: Allowed viewpoints; None traces nothing outward.
        tracer: A tracer of `g` to reuse; None builds one.
        progress: Called with stages "structure", "cameras", "check", "directions" and "angles".

    Returns:
        The analysis.

    Raises:
        ValueError: If there is no camera or `tracer` belongs to another scene.
        SceneError: If the scene is empty.

    References:
        SRBF-Gaussian, section 3.1 and figure 3.
    """
    config = config or AnalysisConfig()
    if len(g) == 0:
        raise SceneError("the scene has no Gaussians")
    if len(cameras) == 0:
        raise ValueError("cameras: expected at least one camera, got none")
    if tracer is not None and tracer.proxies.gaussians is not g:
        got = f"one for a scene of {len(tracer.proxies.gaussians):,} Gaussians"
        raise ValueError(f"tracer: expected a tracer of these {len(g):,} Gaussians, got {got}; omit it to build one")
    progress("structure", 0, 1)
    tracer = tracer or Tracer.named(config.tracer, EllipsoidProxies.from_scene(g))
    _ = tracer.hierarchy
    progress("structure", 1, 1)
    rng = np.random.default_rng(config.seed)
    sample = np.sort(rng.choice(len(g), min(config.traced_sample, len(g)), replace=False))
    visible, sets, settling = _from_cameras(tracer, cameras, config.tau, rng.permutation(len(cameras)), progress)
    check = _check_twice(tracer, cameras, config, progress)
    cdf = DirectionCdf.from_sets(sets)
    found = Analysis(config, len(g), len(tracer.proxies), cameras, visible, sets, cdf, settling, check=check)
    if len(sample) == 0 or navigable is None:
        why = "no sample was requested" if navigable is not None else "no navigable space was given"
        return replace(found, untraced_because=why)
    traced = directions.trace_directions(
        tracer, navigable, ids=sample, rays_per_face=config.rays_per_face, tau=config.tau, progress=progress
    )
    angles = directions.solid_angle_fractions(
        tracer,
        navigable,
        ids=sample,
        rays_per_face=min(config.rays_per_face, _ANGLE_RAYS),
        tau=config.tau,
        progress=lambda _, done, total: progress("angles", done, total),
    )
    return replace(
        found,
        sample=sample,
        traced_sets=traced,
        traced=DirectionCdf.from_sets(traced),
        solid_angles=angles,
        agreement=Agreement.from_sets(sets[sample], traced),
    )


def _from_cameras(
    tracer: Tracer, cameras: Cameras, tau: float, order: NDArray[np.int64], progress: Progress
) -> tuple[NDArray[np.int64], U8, tuple[Settling, ...]]:
    """Return visible counts (C,), direction sets (N, 10) and how they settled, cameras in the given order."""
    g = tracer.proxies.gaussians
    total = len(cameras)
    visible = np.zeros(total, np.int64)
    sets = np.zeros((len(g), directions.NUM_FACES // 8), np.uint8)
    stops = {-(-total // part) for part in (8, 4, 2, 1)}
    settling: list[Settling] = []
    before: DirectionCdf | None = None
    progress("cameras", 0, total)
    for done, c in enumerate(order, 1):
        camera = cameras[int(c)]
        weights = visible_in(tracer, camera)
        visible[c] = np.count_nonzero(weights[0] >= np.float32(tau))
        sets |= directions.seen_directions(g, weights, camera.viewpoints, tau)
        if done in stops:
            cdf = DirectionCdf.from_sets(sets)
            settling.append(Settling.from_cdfs(done, cdf, before))
            before = cdf
        progress("cameras", done, total)
    return visible, sets, tuple(settling)


def _check_twice(tracer: Tracer, cameras: Cameras, config: AnalysisConfig, progress: Progress) -> CrossCheck | None:
    """Trace rays through random pixels of random cameras with two tracers, and compare."""
    if not config.checked_rays:
        return None
    rng = np.random.default_rng([config.seed, 1])
    chosen, counts = np.unique(rng.integers(len(cameras), size=config.checked_rays), return_counts=True)
    rays = []
    for c, count in zip(chosen.tolist(), counts.tolist(), strict=True):
        origins, towards = cameras[c].rays()
        some = rng.integers(len(origins), size=count)
        rays.append((origins[some], towards[some]))
    progress("check", 0, 1)
    found = cross_check(tracer, *(np.concatenate(each) for each in zip(*rays, strict=True)))
    progress("check", 1, 1)
    return found


def _faces(sets: U8) -> int:
    """Return the number of faces in direction sets."""
    return int(np.unpackbits(sets).sum())
