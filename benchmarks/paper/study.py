"""What the figures and tables of the paper are drawn from: one scene, measured once for all of them.

A scene is prepared in our way with its levels, visible sets and colors. Everything is made on first use, so that one
figure alone needs only its own part. Scene frame and units, dB, seconds.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsvis.abr import AbrConfig, BandwidthTrace
from gsvis.cli import parse
from gsvis.cli.arguments import Prepare
from gsvis.cli.prepare import check_arguments
from gsvis.color.evaluate import Evaluator
from gsvis.color.fit import FitConfig, fit_srbf
from gsvis.package import Package
from gsvis.prepare import prepare_package
from gsvis.prepare.importance import ViewImportance, importance_from_views
from gsvis.raycast import DirectionCdf, EllipsoidProxies, Tracer
from gsvis.raycast.directions import trace_directions
from gsvis.render import psnr, rasterize, ssim
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.view_sampling import ViewSampling
from gsvis.simulate import Adaptive, Delivery, Link, MortonProgressive, Stage, ViewingConfig, WholeFile, play, watch
from gsvis.simulate.viewing import Viewing
from gsvis.stream import StreamedScene
from paper.held import HELD, fit_held
from paper.perceptual import Distance, open_lpips
from paper.pieces import Scene
from paper.walk import WalkConfig
from paper.walk_terms import WalkTerms, terms_over_walk

__all__ = ["Likeness", "Study", "clipped"]

F32 = NDArray[np.float32]

_GATHERED = ViewSampling(128, 256, 192, 75.0, stream=13)
_WALK = WalkConfig(seconds=30.0, rate=2.0, width=320, height=240)
_TERMS = 12  # most of a Gaussian
_MEAN_TERMS = 3.0
_PIECE = 0.5  # seconds
_TRACED = 1000  # Gaussians
_RAYS = 16  # over each of the 80 faces
_SEED = 5


@dataclass(frozen=True)
class Likeness:
    """How like the truth images of other colors or levels are, in the mean of the views of the judges.

    Attributes:
        psnr: dB.
        ssim: In [0, 1].
        flip: FLIP error; None where it is not installed.
        lpips: LPIPS on VGG-16; None where its weights are not installed.
    """

    psnr: float
    ssim: float
    flip: float | None
    lpips: float | None = None


class Study:
    """A scene and everything that is measured of it.

    Args:
        scene: The scene, with judges and walks.
        work: Folder for the package.
        prepare: Options of `gsvis prepare`.
        mbit: Rate of the link of the sessions.
        seconds: Length of a session.
    """

    def __init__(self, scene: Scene, work: Path, prepare: list[str], mbit: float, seconds: float) -> None:
        self.scene = scene
        self.work = work
        self.mbit = mbit
        self.seconds = seconds
        self._measured: dict[str, Likeness] = {}
        # The name of a scene decides no setting: any that exists will do.
        self._words = ["prepare", "builtin:two_rooms", "-o", "out.gsvis", *prepare]

    @cached_property
    def package(self) -> Package:
        """The scene as a package in our way; open until the process ends."""
        command = parse(self._words)
        assert isinstance(command, Prepare)
        config = check_arguments(command)
        out = self.work / "scene.gsvis"
        prepare_package(self.scene.gaussians, out, self.scene.space, config, photos=self.scene.photos)
        return Package.open(out)

    @property
    def by_photographs(self) -> bool:
        """Whether photographs are the truth, not the scene's own images."""
        return self.scene.photos is not None

    @cached_property
    def lpips(self) -> Distance | None:
        """LPIPS, where its weights are installed."""
        return open_lpips()

    @cached_property
    def gathered(self) -> ViewImportance:
        """From where views see each Gaussian, and how much."""
        cameras = _GATHERED.cameras(self.scene.gaussians, self.scene.space)
        return importance_from_views(self.scene.gaussians, cameras)

    @property
    def directions(self) -> DirectionCdf:
        """The distribution of figure 3."""
        return DirectionCdf.from_sets(self.gathered.sets)

    @property
    def directions_views(self) -> int:
        """Number of views of figure 3."""
        return _GATHERED.count

    @cached_property
    def traced(self) -> DirectionCdf:
        """The same of a sample, by rays outward: which directions lead to where eyes may be."""
        g = self.scene.gaussians
        count = min(_TRACED, len(g))
        ids = np.random.default_rng(_SEED).choice(len(g), count, replace=False)
        tracer = Tracer(EllipsoidProxies.from_scene(g))
        return DirectionCdf.from_sets(trace_directions(tracer, self.scene.space, ids=ids, rays_per_face=_RAYS))

    def level(self, name: int) -> tuple[Gaussians, NDArray[np.bool_]]:
        """Return all Gaussians of the package, and which belong to a level; -1 is the highest."""
        contents = self.package.contents
        k = name % len(contents.names)
        return contents.gaussians(), np.asarray((contents.first <= k) & (k <= contents.last))

    @property
    def low(self) -> int:
        """The level called low; below it there may be a preview, which the paper lacks."""
        return self.package.contents.names.index("low")

    @cached_property
    def package_colors(self) -> Evaluator:
        """Colors of the package with all terms."""
        return Evaluator(self.package.contents.colors().dequantize())

    def draw_level(self, camera: Cameras, held: NDArray[np.bool_]) -> F32:
        """Return the image of some Gaussians of the package with all their terms."""
        g = self.package.contents.gaussians()
        colors = self.package_colors.colors(g.means, camera.viewpoints[0])
        return clipped(rasterize(g[held], camera, colors=colors[held]).images[0])

    def draw_scene(self, camera: Cameras) -> F32:
        """Return the image of the scene itself."""
        return clipped(rasterize(self.scene.gaussians, camera).images[0])

    def compare(self, draw: Any) -> Likeness:
        """Return how like the truth are images of `draw(camera)`, in all views of the judges."""
        images = [draw(self.scene.judges[c]) for c in range(len(self.scene.judges))]
        return likeness(np.stack(images), np.stack(self.scene.truth), self.lpips)

    @cached_property
    def variants(self) -> dict[str, Any]:
        """Functions from an eye to colors (N, 3), by the variants of table 3; terms as the paper finds them, by OMP."""
        g = self.scene.gaussians
        seen = self.gathered
        found: dict[str, Any] = {}
        for variant in ("hsl", "rgb"):
            config = FitConfig(variant, max_terms=_TERMS, mean_terms=_MEAN_TERMS, refine=False)
            colors = Evaluator(fit_srbf(g, seen.sets, config, importance=seen.importance).colors)
            found[variant] = lambda eye, colors=colors: colors.colors(g.means, eye)
        config = FitConfig("rgb", max_terms=_TERMS, mean_terms=_MEAN_TERMS)
        ours = Evaluator(fit_srbf(g, seen.sets, config, importance=seen.importance).colors)
        found["ours"] = lambda eye: ours.colors(g.means, eye)
        for name in HELD:
            held = fit_held(g, seen.sets, name, _MEAN_TERMS, _TERMS, seen.importance)
            found[name] = lambda eye, held=held: held.colors(g.means, eye)
        return found

    def draw_variant(self, name: str, camera: Cameras) -> F32:
        """Return the image of the scene with colors of a variant."""
        colors = self.variants[name](camera.viewpoints[0])
        return clipped(rasterize(self.scene.gaussians, camera, colors=colors).images[0])

    def variant_likeness(self, name: str) -> Likeness:
        """Return how like the truth the scene is with colors of a variant; measured once."""
        if name not in self._measured:
            self._measured[name] = self.compare(lambda camera: self.draw_variant(name, camera))
        return self._measured[name]

    @cached_property
    def scene_likeness(self) -> Likeness:
        """How like the truth the scene itself is."""
        return self.compare(self.draw_scene)

    @cached_property
    def walk_terms(self) -> WalkTerms:
        """The curves of figure 13, on the first walk."""
        g, held = self.level(-1)
        colors = self.package.contents.colors().dequantize()[held]
        assert self.package.epsilon is not None
        return terms_over_walk(colors, g[held], self.scene.walks[0], self.package.epsilon, config=_WALK)

    @cached_property
    def sessions(self) -> dict[str, list[Viewing]]:
        """Sessions on each walk, by the name of the system."""
        streamed = StreamedScene.open(self.package)
        stage = Stage(streamed.contents, self.scene.gaussians)
        config = ViewingConfig(seconds=self.seconds, every=_PIECE, fine=3.0)
        link = Link(BandwidthTrace.constant(self.mbit), 0.04)
        found: dict[str, list[Viewing]] = {}
        for walk in self.scene.walks:
            systems = _systems(streamed, config)
            played = [
                play(each, link, walk, stage.size, seconds=config.watched, tick=config.tick)
                for each in systems.values()
            ]
            for name, seen in zip(systems, watch(stage, played, walk, config), strict=True):
                found.setdefault(name, []).append(seen)
        return found


def _systems(streamed: StreamedScene, config: ViewingConfig) -> dict[str, Delivery]:
    """Return fresh deliveries by name."""
    contents = streamed.contents
    progressive = MortonProgressive(contents)
    return {
        "gsvis": Adaptive(streamed, config.view, AbrConfig()),
        "as the paper sends": Adaptive(streamed.sending("cell"), config.view, AbrConfig(policy="fov-first")),
        "whole file": WholeFile(contents, int(progressive.nbytes), "records of the highest level"),
        "Morton order": progressive,
    }


def likeness(images: F32, truth: F32, lpips: Distance | None = None) -> Likeness:
    """Return the mean likeness of images (C, H, W, 3) and the truth; LPIPS if it is given."""
    from gsvis.prepare.color_quality import has_flip
    from gsvis.render import flip

    pairs = list(zip(images, truth, strict=True))
    db = [min(100.0, float(psnr(one, other))) for one, other in pairs]
    alike = [float(ssim(one, other)) for one, other in pairs]
    seen = float(np.mean([float(flip(one, other)) for one, other in pairs])) if has_flip() else None
    apart = None if lpips is None else float(np.mean([lpips(one, other) for one, other in pairs]))
    return Likeness(float(np.mean(db)), float(np.mean(alike)), seen, apart)


def clipped(image: F32) -> F32:
    """Return an image in [0, 1], as a display shows it."""
    return np.asarray(np.clip(image, 0.0, 1.0), np.float32)
