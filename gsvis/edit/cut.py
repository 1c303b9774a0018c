"""Cut a scene to the Gaussians that some eyes can see: along a walk, at cameras, or in a box.

First, a set is collected from some places. Random rays then bound the light that the set misses; Gaussians that they
find are added until the bound is low enough. Finally, held-out views of scene and set are compared, and Gaussians that
bad views lack are added too. Scene frame and units.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsvis import _check
from gsvis.edit.eyes import Eyes
from gsvis.errors import SceneError
from gsvis.progress import Progress, silent
from gsvis.pvs.certificate import Certificate, CertificateConfig, Certifier
from gsvis.pvs.look import Look, Sight
from gsvis.pvs.quality_result import PSNR_CAP
from gsvis.pvs.tiles import probe_tiles
from gsvis.raycast import TAU, CrossCheck, EllipsoidProxies, Tracer, cross_check
from gsvis.render import rasterize, view_weights
from gsvis.render.metrics import psnr
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.view_sampling import ViewSampling

__all__ = ["Cut", "CutConfig", "HeldOut", "cut"]

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
Mask = NDArray[np.bool_]

_TILES = 8  # worst rays whose tiles are traced
_TURNS = 4  # most probes of these tiles in one stage
_LOOKED = 0.1  # share of the limit that the estimate must exceed for a further look
_MORE_RAYS = 16  # largest factor on the number of rays if few meet something
_RESERVE = 5.0  # dB above the least PSNR up to which views are repaired, because unseen views may be worse
_FAINT = 0.25  # share of tau from which a Gaussian that a bad view lacks is added
_VIEWS = ViewSampling(16, 640, 480, 90.0)
_STREAM = 100  # first random stream of the held-out views; each round has its own


@dataclass(frozen=True, kw_only=True)
class CutConfig:
    """Options of a cut.

    Attributes:
        tau: Least weight of a Gaussian that is kept, in [1e-6, 0.5].
        size: Pixels along a side of the six faces around an eye in a space.
        limit: Stages end when the 95% bound of the share of missing light is at most this, and `tile_limit` holds.
        tile_limit: Largest share of missing light in a tile of 16 x 16 pixels around the worst rays.
        rays: Largest number of rays of one certificate.
        max_stages: Largest number of certificates; the last is kept even if it is above the limits.
        views: Number, size, field of view and seed of held-out views; 0 views for none.
        min_psnr: If a held-out view is below this, dB, Gaussians are added that views up to 5 dB above it lack, and new
            views are drawn.
        rounds: Largest number of rounds of held-out views; the last adds nothing.
        seed: Seed of all random numbers.
    """

    tau: float = TAU
    size: int = 512
    limit: float = 0.0015
    tile_limit: float = 0.1
    rays: int = 8192
    max_stages: int = 17
    views: ViewSampling = _VIEWS
    min_psnr: float = 45.0
    rounds: int = 4
    seed: int = 0

    def __post_init__(self) -> None:
        for name, least in (("size", 4), ("rays", 1), ("max_stages", 1), ("rounds", 1), ("seed", 0)):
            _check.positive_int(name, getattr(self, name), at_least=least)
        for name, low, high in (
            ("tau", 1e-6, 0.5),
            ("limit", 1e-6, 1.0),
            ("tile_limit", 1e-6, 1.0),
            ("min_psnr", 0.0, PSNR_CAP),
        ):
            if not low <= getattr(self, name) <= high:
                raise ValueError(f"{name}: expected a value in [{low:g}, {high:g}], got {getattr(self, name)!r}")


@dataclass(frozen=True, eq=False)
class HeldOut:
    """Views that were not used to make a set, rendered from the scene and from the set.

    Attributes:
        cameras: The C views.
        psnr: (C,) dB of each view of the set against the scene; `PSNR_CAP` for equal images.
        rounds: Number of rounds of views; all but the last added Gaussians that bad views lacked.
        added: Number of Gaussians added because of them.
        fresh: Whether none of these views was used to make the set.
    """

    cameras: Cameras
    psnr: F64
    rounds: int
    added: int
    fresh: bool

    def as_dict(self) -> dict[str, Any]:
        """Return the figures as plain numbers for JSON."""
        return {
            "views": len(self.cameras),
            "width": self.cameras.width,
            "height": self.cameras.height,
            "worst_psnr": float(self.psnr.min()),
            "mean_psnr": float(self.psnr.mean()),
            "rounds": self.rounds,
            "added": self.added,
            "fresh": self.fresh,
        }


@dataclass(frozen=True, eq=False)
class Cut:
    """The part of a scene of N Gaussians that is kept.

    Attributes:
        kept: (N,) True for Gaussians that the eyes can see.
        weights: (N,) float32, largest weight found of each kept Gaussian; 0 for the others.
        looks: Number of places from which the set was collected.
        buried: Number of places that were skipped because they lie inside something solid.
        certificates: Certificates of the set while it grew, oldest first; empty if no ray could start.
        check: Comparison with a second tracer on some rays; None if it is not installed, or no ray could start.
        held_out: Held-out views; None without any.
    """

    kept: Mask
    weights: F32
    looks: int
    buried: int
    certificates: tuple[Certificate, ...]
    check: CrossCheck | None
    held_out: HeldOut | None

    def __len__(self) -> int:
        """Number of Gaussians kept."""
        return int(np.count_nonzero(self.kept))

    def __repr__(self) -> str:
        return f"Cut({len(self):,} of {len(self.kept):,} Gaussians, {self.missed:.4%} of the light missing)"

    @property
    def missed(self) -> float:
        """Estimated share of the light that is missing, before the last addition; NaN without a certificate."""
        return self.certificates[-1].missed if self.certificates else float("nan")

    @property
    def bound(self) -> float:
        """Upper 95% confidence bound of the share of the light that is missing; NaN without a certificate."""
        return self.certificates[-1].bound if self.certificates else float("nan")

    @property
    def rays(self) -> int:
        """Rays of all certificates."""
        return sum(map(len, self.certificates))

    def as_dict(self) -> dict[str, Any]:
        """Return the figures as plain numbers for JSON."""
        check = self.check
        return {
            "gaussians_in": len(self.kept),
            "gaussians_out": len(self),
            "looks": self.looks,
            "buried": self.buried,
            "certificate": None
            if not self.certificates
            else {
                "rays": self.rays,
                "stages": len(self.certificates),
                "missed": self.missed,
                "bound": self.bound,
                "error": self.certificates[-1].error,
                "rays_traced_twice": 0 if check is None else check.rays,
                "rays_agreeing": 0 if check is None else check.agreeing,
            },
            "held_out": None if self.held_out is None else self.held_out.as_dict(),
        }


def cut(g: Gaussians, eyes: Eyes, config: CutConfig | None = None, *, progress: Progress = silent) -> Cut:
    """Find the Gaussians that some eyes can see.

    Args:
        g: The scene, N Gaussians.
        eyes: The eyes: `EyesInSpace` or `EyesOfCameras`.
        config: Options; None means `CutConfig()`.
        progress: Called with stages "structure", "viewpoints", "certificate" and "held_out".

    Returns:
        The kept set with its certificates; `g[result.kept]` is the smaller scene.

    Raises:
        SceneError: If the eyes see nothing, or the scene has no Gaussian with an opacity of at least 1/255.

    Examples:
        >>> from gsvis.scene.procedural import two_rooms
        >>> from gsvis.edit import CutConfig, EyesInSpace, cut
        >>> from gsvis.scene.navigable import NavigableSpace
        >>> scene = two_rooms(1000, sh_degree=0).gaussians
        >>> corner = NavigableSpace.from_box((0.5, 0.5, 0.5), (1.5, 1.5, 1.5), 8)
        >>> found = cut(scene, EyesInSpace(corner, boxes=1), CutConfig(size=64))
        >>> 0 < len(found) < 0.8 * len(scene) and found.bound < 0.01
        True
    """
    config = config or CutConfig()
    growing = _Growing(g, eyes, config)
    progress("structure", 0, 1)
    certifier = Certifier(Tracer(EllipsoidProxies.from_scene(g)))
    _ = certifier.tracer.hierarchy
    progress("structure", 1, 1)
    looks, lost = growing.look(progress)
    certificates = growing.certify(certifier, progress)
    if looks == 0 and not certificates:
        raise SceneError(f"all of {lost} places to look from lie inside something solid; give eyes in the open")
    if not growing.kept.any():
        raise SceneError("everything would go: no eye sees any of the scene; are they in its frame?")
    check = None
    if certificates:
        check = cross_check(certifier.tracer, certificates[-1].checked_o, certificates[-1].checked_d)
    del certifier  # frees memory for rendering
    held_out = growing.hold_out(progress) if config.views.count else None
    return Cut(growing.kept, growing.weights, looks, lost, tuple(certificates), check, held_out)


class _Growing:
    """A set that is being extended.

    Attributes:
        weights: (N,) float32, largest weight found so far; 0 for Gaussians outside the set.
    """

    def __init__(self, g: Gaussians, eyes: Eyes, config: CutConfig) -> None:
        self.g = g
        self.eyes = eyes
        self.config = config
        self.weights = np.zeros(len(g), np.float32)
        self._see = Look(g, "hybrid", config.size, config.tau)

    @property
    def kept(self) -> Mask:
        """(N,) the set."""
        return self.weights > 0.0

    def add(self, found: Sight | None) -> None:
        """Add the Gaussians that an eye or some rays found."""
        if found is not None:
            ids, weights = found
            self.weights[ids] = np.maximum(self.weights[ids], weights)

    def look(self, progress: Progress) -> tuple[int, int]:
        """Look from all places; return the numbers of places outside and inside solid parts."""
        total = self.eyes.count_looks()
        seen = 0
        lost = 0
        progress("viewpoints", 0, total)
        for done, found in enumerate(self.eyes.iter_looks(self._see, self.config.seed), 1):
            self.add(found)
            seen, lost = (seen, lost + 1) if found is None else (seen + 1, lost)
            progress("viewpoints", done, total)
        return seen, lost

    def certify(self, certifier: Certifier, progress: Progress) -> list[Certificate]:
        """Certify the set and add missing Gaussians, stage by stage; return the certificates, oldest first."""
        config = self.config
        options = CertificateConfig(
            limit=config.limit, rays=config.rays, worst=_TILES, tau=config.tau, seed=config.seed
        )
        stages: list[Certificate] = []
        progress("certificate", 0, config.max_stages)
        while len(stages) < config.max_stages:
            ids = np.flatnonzero(self.kept)
            found = self.eyes.certify(certifier, ids, options, len(stages), stages)
            if found is None:
                break
            stages.append(found)
            self.add((found.ids, found.id_weights))
            tile = self._mend_tiles(certifier.tracer, found)
            progress("certificate", len(stages), config.max_stages)
            if not found.weights.any() or (found.bound <= config.limit and tile <= config.tile_limit):
                break
            options = _with_more_rays(options, config.rays, found)
            if found.bound > config.limit and found.missed > _LOOKED * config.limit:
                self.add(self.eyes.look_again(self._see, found.worst_o[0]))
        progress("certificate", config.max_stages, config.max_stages)
        return stages

    def _mend_tiles(self, tracer: Tracer, found: Certificate) -> float:
        """Add missing Gaussians in tiles around the worst rays; return the share of light that the worst tile lacks."""
        tile = 0.0
        for turn in range(_TURNS):
            tiles = probe_tiles(tracer, self.kept, found.worst_o, found.worst_d, self.config.tau, turn=turn)
            self.add((tiles.ids, tiles.id_weights))
            tile = float(tiles.missed.max(initial=0.0))
            if tile <= self.config.tile_limit:
                break
        return tile

    def hold_out(self, progress: Progress) -> HeldOut:
        """Render views of the scene and of the set, and add Gaussians that bad views lack, round by round."""
        config = self.config
        before = int(np.count_nonzero(self.kept))
        total = config.rounds * config.views.count
        progress("held_out", 0, total)
        for k in range(config.rounds):
            sampling = replace(config.views, seed=config.seed, stream=_STREAM + k)
            views = self.eyes.draw_views(self.g, sampling)
            kept = self.g[self.kept]
            values = np.zeros(len(views))
            for c in range(len(views)):
                values[c] = _compare(self.g, kept, views[c])
                progress("held_out", k * config.views.count + c + 1, total)
            if values.min() >= config.min_psnr or k == config.rounds - 1:
                break
            for c in np.flatnonzero(values < config.min_psnr + _RESERVE).tolist():
                largest = view_weights(self.g, views[c]).largest[0]
                self.add(_at_least(largest, _FAINT * config.tau))
        progress("held_out", total, total)
        added = int(np.count_nonzero(self.kept)) - before
        return HeldOut(views, values, k + 1, added, not self.eyes.repeats)


def _at_least(largest: F32, floor: float) -> Sight:
    """Return the Gaussians whose weight reaches a limit."""
    ids = np.flatnonzero(largest >= np.float32(floor))
    return ids, largest[ids]


def _compare(g: Gaussians, kept: Gaussians, view: Cameras) -> float:
    """Return the PSNR of a view of a part of a scene against the scene, dB."""
    wanted, got = (rasterize(each, view, backend="cpu").images[0] for each in (g, kept))
    return min(float(psnr(got, wanted)), PSNR_CAP)


def _with_more_rays(options: CertificateConfig, rays: int, found: Certificate) -> CertificateConfig:
    """Return options with more rays if only few rays meet something, because the others prove nothing."""
    factor = min(_MORE_RAYS, round(1.0 / max(float(found.weights.mean()), 1.0 / _MORE_RAYS)))
    return replace(options, rays=factor * rays, round_rays=factor * CertificateConfig.round_rays)
