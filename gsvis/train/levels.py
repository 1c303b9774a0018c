"""Train quality levels that share Gaussians: the most important ones of a scene, frozen, and a few more to repair.

The highest level is the scene itself. Each lower level keeps a part of it unchanged, nested in the part that the next
level keeps. A few merged Gaussians represent the rest; they are trained on photos, or on renders of the scene if there
are none. An upgrade therefore sends only the difference. docs/design/019-levels.md reports what was tested. Below them
lies a first picture of few merged Gaussians, which arrives at once (docs/design/069-what-is-in-view-first.md).

References:
    SRBF-Gaussian, section 6.1.
"""

from __future__ import annotations

import hashlib
import math
import os
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gsvis import _check
from gsvis._extras import require
from gsvis.errors import ArgumentError, FormatError
from gsvis.files.mapped import release_mapped
from gsvis.jobs.freed_memory import release_freed_memory
from gsvis.jobs.resume import KeptWork
from gsvis.progress import Progress, silent
from gsvis.scene.cameras import Cameras
from gsvis.scene.content import scene_hash, sight_hash
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.levels import PREVIEW, Levels
from gsvis.scene.navigable import NavigableSpace
from gsvis.train.choosing import LOOKS, choose_subsets
from gsvis.train.config import DensifyConfig, TrainConfig
from gsvis.train.fill_in import fit_opacities
from gsvis.train.history import Record
from gsvis.train.images import PosedImages
from gsvis.train.importance import ROUNDS, most_important, prune, rank_by_error
from gsvis.train.likeness import mean_psnr
from gsvis.train.pairs import merge_pairs

__all__ = ["CHOICES", "SUBSETS", "LevelsConfig", "TrainedLevels", "frozen_sizes", "train_levels"]

SUBSETS = "subsets.npz"
"""File name of the chosen subsets in a folder of unfinished work."""

Mask = NDArray[np.bool_]

CHOICES = ("removal", "gradient")
"""Ways to choose the Gaussians that stay in lower levels."""

_FAINT = 0.05  # opacity of a clone of a Gaussian that stays
_PREVIEW_NAME = "preview"
_STEPS = 400  # of training, for which the default number of looks was chosen
_FEWEST_LOOKS = 30
# Learning rates of a level by how far it begins from its images: see `_slowed`.
_SLOWEST = 0.45
_FULL = 27.0  # dB, up to which they are full
_LOOKED_AT = 16  # images
_CHOICE = 3  # increase it if the same cameras would choose different Gaussians


@dataclass(frozen=True)
class LevelsConfig:
    """Sizes of the levels below the scene itself, and options of their training.

    Attributes:
        shares: Largest number of Gaussians of each level, as a share of the scene's; ascending, in (0, 1).
        reuse: Least share of each level that belongs to the next level too, in [0, 1].
        names: Names of these levels, and of the scene itself as the last.
        iterations: Training steps for each level.
        merged: Share of a level's own Gaussians that start as merges of the Gaussians it lacks; the rest are clones
            that training adds where needed. 0 begins with one faint clone: a merge of all that a level lacks would be
            as large as the scene, and so would its clones.
        threshold: Gradient above which a Gaussian is cloned; see `DensifyConfig`.
        most_share: Largest number of Gaussians of a level to clone at a time, as a share of all.
        prune_share: Share of the remaining Gaussians that one round of `prune` removes, if the views choose the frozen
            Gaussians.
        importance: How Gaussians that stay are chosen: one of `CHOICES`. "removal": by what their removal changes while
            most others go too. "gradient": by equation 6, at once for all levels; see `rank_by_error`.
        looks: Number of views of such a round, None for all. With separate cameras for choosing: the number of looks of
            `choose_subsets`, None for as many as suit the steps (`looks_to_choose`).
        evaluate_every: Steps between measurements on held-out views; 0 measures only at the end.
        seed: Seed of training.
        backend: Backend of the rasterizer, which also says where levels are trained: "cuda" on a GPU. What stays in
            them is chosen on the CPU.
        preview: Number of merged Gaussians of the first picture, as a share of the scene's, in [0, `PREVIEW`]; 0 for
            none. It is the lowest level, with the name "preview".
        preview_from: Least number of Gaussians of a scene with a first picture; see `fit_to`.
    """

    shares: tuple[float, ...] = (0.25, 0.5)
    reuse: tuple[float, ...] = (0.90, 0.96)
    names: tuple[str, ...] = ("low", "medium", "high")
    iterations: int = _STEPS
    merged: float = 1.0
    threshold: float = 4e-4
    most_share: float = 0.01
    prune_share: float = 0.35
    importance: str = "removal"
    looks: int | None = None
    evaluate_every: int = 500
    seed: int = 0
    backend: str = "auto"
    preview: float = 0.02
    preview_from: int = 50_000

    def __post_init__(self) -> None:
        for name in ("shares", "reuse", "names"):
            object.__setattr__(self, name, tuple(getattr(self, name)))
        for value in self.shares:
            if not 0.0 < value <= 1.0:
                raise ArgumentError("shares", f"expected shares in (0, 1], got {value!r}")
        for value in self.reuse:
            if not 0.0 <= value <= 1.0:
                raise ArgumentError("reuse", f"expected shares in [0, 1], got {value!r}")
        if not self.shares or any(low >= high for low, high in zip(self.shares, (*self.shares[1:], 1.0), strict=True)):
            raise ArgumentError(
                "shares",
                f"expected each below the next and the last below 1, got {list(self.shares)}",
                "a level cannot be larger than the one above it",
            )
        if len(self.reuse) != len(self.shares):
            raise ValueError(f"reuse: expected one for each of {len(self.shares)} shares, got {len(self.reuse)}")
        frozen = [r * s for r, s in zip(self.reuse, self.shares, strict=True)]
        if sorted(frozen) != frozen:
            raise ValueError(f"reuse: expected each level to keep more of the scene than the one below, got {frozen}")
        if len(self.names) != len(self.shares) + 1 or len(set(self.names)) != len(self.names):
            raise ValueError(
                f"names: expected {len(self.shares) + 1} different ones, the scene's own last, got {list(self.names)}"
            )
        if not 0.0 <= self.preview <= PREVIEW:
            raise ArgumentError("preview", f"expected a share in [0, {PREVIEW:g}], got {self.preview!r}")
        if self.preview and self.shares[0] > PREVIEW and _PREVIEW_NAME in self.names:
            raise ValueError(f"names: expected none that is {_PREVIEW_NAME!r} beside a first picture, got it")
        _check.positive_int("preview_from", self.preview_from, at_least=0)
        if not 0.0 <= self.merged <= 1.0:
            raise ValueError(f"merged: expected a share in [0, 1], got {self.merged!r}")
        if not 0.0 < self.prune_share < 1.0:
            raise ValueError(f"prune_share: expected a share in (0, 1), got {self.prune_share!r}")
        _check.one_of("importance", self.importance, CHOICES)
        if self.looks is not None:
            _check.positive_int("looks", self.looks)
        self.training(2, 1)

    def fit_to(self, count: int) -> LevelsConfig:
        """Return the same settings, without a first picture if a scene of `count` Gaussians needs none.

        In a small scene the next level arrives as soon. A level of at most a share of `PREVIEW` is itself a first
        picture.
        """
        needs = count >= self.preview_from and self.shares[0] > PREVIEW
        return self if needs else replace(self, preview=0.0)

    @property
    def looks_to_choose(self) -> int:
        """Looks of `choose_subsets`: as asked for, or its default for 400 steps and with the root of the steps."""
        if self.looks is not None:
            return self.looks
        return max(round(LOOKS * math.sqrt(self.iterations / _STEPS)), _FEWEST_LOOKS)

    @property
    def level_names(self) -> tuple[str, ...]:
        """Names of all levels, lowest first."""
        return (_PREVIEW_NAME, *self.names) if self.preview else self.names

    def sizes(self, count: int) -> list[tuple[int, int, int]]:
        """Return for each level below a scene of `count` Gaussians: the maximum, the frozen and the initial number.

        All three are equal if the requested reuse leaves a level no own Gaussians to train. A first picture, which not
        every scene has (`fit_to`), has no frozen Gaussians.

        Raises:
            ValueError: If a level would have fewer than 2.
        """
        found = []
        preview = self.fit_to(count).preview
        first = [(preview, 0.0)] if preview else []
        for share, reuse in [*first, *zip(self.shares, self.reuse, strict=True)]:
            total = int(share * count + 1e-9)
            frozen = max(int(np.ceil(reuse * total - 1e-9)), 1) if reuse else 0
            if total < 2:
                raise ArgumentError("shares", f"expected at least 2 Gaussians in each level, got {share:g} of {count}")
            merged = self.merged if frozen or self.merged else 1.0  # nothing stays that could be cloned
            found.append((total, frozen, min(frozen + max(round(merged * (total - frozen)), 1), total)))
        return found

    def training(self, most_count: int, sh_degree: int) -> TrainConfig:
        """Return the training options of a level of at most `most_count` Gaussians.

        References:
            SRBF-Gaussian, section 6.1: a higher threshold, clones instead of splits, at most 1% of all at a time.
        """
        rules = DensifyConfig(
            start=0,
            stop=(3 * self.iterations) // 4,
            every=min(100, max(self.iterations // 15, 1)),
            threshold=self.threshold,
            split=False,
            most_share=self.most_share,
            most_count=most_count,
            reset_every=0,
        )
        return TrainConfig(
            iterations=self.iterations,
            sh_degree=sh_degree,
            sh_every=0,
            means_rate=4e-4,  # faster than for a scene from scratch, because there are few steps
            means_rate_end=4e-5,
            scales_rate=0.006,
            opacities_rate=0.06,
            sh0_rate=0.006,
            rates_end=0.1,
            densify=rules,
            evaluate_every=self.evaluate_every,
            seed=self.seed,
            backend=self.backend,
        )


@dataclass(frozen=True, eq=False)
class TrainedLevels:
    """Levels and the history of their training.

    Attributes:
        levels: The scene's Gaussians first, in their order, then each lower level's own.
        histories: Records of training, by the name of the level; none for a level without Gaussians of its own.
    """

    levels: Levels
    histories: dict[str, list[Record]]


def train_levels(
    scene: Gaussians,
    views: PosedImages,
    config: LevelsConfig | None = None,
    *,
    held_out: PosedImages | None = None,
    choose_by: Cameras | None = None,
    space: NavigableSpace | None = None,
    work: str | os.PathLike[str] | None = None,
    progress: Progress = silent,
) -> TrainedLevels:
    """Train the levels of a scene.

    Args:
        scene: N Gaussians, the highest level.
        views: Target images of lower levels: photos, or `render_views` of the scene.
        config: Sizes and training; None means `LevelsConfig()`.
        held_out: Views to measure on, never trained on.
        choose_by: Cameras for choosing the frozen Gaussians; None for those of the views, at half their size. Give many
            cameras everywhere, in random order: a Gaussian that none of them sees well is dropped first.
        space: Voxels that stop light, which save time in rooms; None for none.
        work: A folder for unfinished work, to resume from if it exists; it must belong to the same scene, views and
            configuration. It is kept at the end.
        progress: Called with stages "prune" and "train NAME".

    Raises:
        ValueError: If a level would be empty, there are no views, or `work` belongs to a different run.
        FormatError: If a file in `work` is damaged.
        BackendError: If torch is missing.
    """
    require("training of levels", "torch")
    from gsvis.train.trainer import Trainer

    config = (config or LevelsConfig()).fit_to(len(scene))
    if len(views) == 0:
        raise ValueError("views: expected at least one image to train on, got none")
    sizes = config.sizes(len(scene))
    if work is not None:
        work = _check.path("work", work)
        work.mkdir(parents=True, exist_ok=True)
    masks = _subsets(scene, views, choose_by, space, sizes, config, work, progress)
    top = len(sizes)
    first = np.full(len(scene), top, np.uint8)
    owns: list[Gaussians] = []
    histories: dict[str, list[Record]] = {}
    for k in reversed(range(top)):  # a lower level keeps less
        first[masks[sizes[k][1]]] = k
    for k, (total, frozen, begun) in enumerate(sizes):
        name = config.level_names[k]
        stays = masks[frozen]

        def report(stage: str, done: int, of: int, name: str = name) -> None:
            """Report progress with the name of the level."""
            progress(f"train {name}", done, of)

        if begun == frozen:  # no Gaussians of its own
            owns.append(scene[stays][:0])
            histories[name] = []
            continue
        if config.merged == 0.0 and frozen:
            begin = _clone_one(scene[stays])
        else:  # photographs differ from the scene by more than a merge does
            begin = _merge_rest(scene, stays, begun - frozen, None if choose_by is None else views)
        training = config.training(total, scene.sh_degree)
        if begun == total:  # no room for clones
            training = replace(training, densify=None)
        if config.merged and choose_by is not None and (k or not config.preview):  # it resembles its images already
            training = _slowed(training, Gaussians.concatenate([scene[stays], begin]), views)
        trainer = Trainer(views, begin, training, frozen=scene[stays], held_out=held_out, space=space)
        _rest(scene)
        kept = None if work is None else Path(work) / f"{name}.checkpoint"
        result = trainer.run(checkpoint=kept, progress=report)
        owns.append(result.gaussians[frozen:])
        histories[name] = result.history
        del trainer, result, begin  # before the next one, or the union
    own = np.repeat(np.arange(top, dtype=np.uint8), [len(part) for part in owns])
    last = np.concatenate([np.full(len(scene), top, np.uint8), own])
    union = Gaussians.concatenate([scene, *owns])
    return TrainedLevels(Levels(union, np.concatenate([first, own]), last, config.level_names), histories)


def _rest(scene: Gaussians) -> None:
    """Give back what was freed, and the memory of a scene that lies in mapped files: copies of its rows were made."""
    release_mapped(vars(scene).values())
    release_freed_memory()


def _merge_rest(scene: Gaussians, stays: Mask, count: int, views: PosedImages | None) -> Gaussians:
    """Return the Gaussians that do not stay, merged into `count`; with views their opacities are fitted to these."""
    merged = merge_pairs(scene[~stays], count)
    _rest(scene)
    return merged if views is None else fit_opacities(merged, scene[stays], views)


def _clone_one(stays: Gaussians) -> Gaussians:
    """Return a faint copy of the Gaussian with the largest opacity times area; independent of their order."""
    covered = stays.opacities * np.sort(stays.scales, axis=1)[:, 1:].prod(axis=1)
    one = stays[most_important(stays, covered, 1)]
    return replace(one, opacities=np.minimum(one.opacities, np.float32(_FAINT)))


def _slowed(training: TrainConfig, begin: Gaussians, views: PosedImages) -> TrainConfig:
    """Return the same training with rates in proportion to the squared error that a level begins with.

    Near its images full rates make views worse that nobody trained on; far from them low rates do not get there.
    docs/design/117-levels-above-a-decimator.md has both for seven scenes.
    """
    some = views[np.unique(np.linspace(0, len(views) - 1, _LOOKED_AT).astype(np.int64))]
    errors = [10.0 ** (-0.1 * mean_psnr(begin, some[k : k + 1])) for k in range(len(some))]
    factor = float(np.clip(np.mean(errors) * 10.0 ** (0.1 * _FULL), _SLOWEST, 1.0))
    names = [each.name for each in fields(training) if each.name.endswith(("_rate", "_rate_end"))]
    return replace(training, **{name: factor * getattr(training, name) for name in names})


def _subsets(
    scene: Gaussians,
    views: PosedImages,
    choose_by: Cameras | None,
    space: NavigableSpace | None,
    sizes: list[tuple[int, int, int]],
    config: LevelsConfig,
    work: str | os.PathLike[str] | None,
    progress: Progress,
) -> dict[int, Mask]:
    """Return nested masks by their size, from a file of the same run if it exists."""
    counts = frozen_sizes(sizes)
    none = {0: np.zeros(len(scene), bool)}
    if not counts:
        return none
    cameras = _halve(views.cameras) if choose_by is None else choose_by

    def choose(kept: KeptWork | None = None) -> list[Mask]:
        """Return the masks, chosen by cameras or views."""
        if config.importance == "gradient":
            return rank_by_error(scene, views, counts, photographs=choose_by is None, progress=progress)
        if choose_by is None:
            share = config.prune_share
            looks = config.looks
            return prune(scene, cameras, counts, share=share, looks=looks, work=kept, progress=progress)
        looks = config.looks_to_choose
        return choose_subsets(scene, cameras, counts, looks=looks, space=space, work=kept, progress=progress)

    if work is None:
        return none | dict(zip(counts, choose(), strict=True))
    shape = cameras.width, cameras.height
    hides = None if space is None else sight_hash(space)
    looks = config.looks if choose_by is None else config.looks_to_choose
    rules = [_CHOICE, scene_hash(scene), counts, config.prune_share, looks, shape, choose_by is not None, hides]
    rules += [] if config.importance == "removal" else [config.importance]
    digest = hashlib.sha256()
    for array in (views.images, views.cameras.viewmats, views.cameras.Ks, cameras.viewmats, cameras.Ks):
        digest.update(np.ascontiguousarray(array).data)
    kept = KeptWork(work, {"rules": rules, "views": digest.hexdigest()}, argument="work")
    found = kept.read_own(SUBSETS)
    if found is not None:
        try:
            bits = np.unpackbits(found["masks"], axis=1, count=len(scene)).astype(bool)
            if bits.sum(axis=1).tolist() != counts:
                raise ValueError("masks of other sizes")
        except (LookupError, TypeError, ValueError) as error:
            got = f"{type(error).__name__}: {error}"
            raise FormatError(
                kept.folder / SUBSETS, "", "the chosen subsets", got, "delete it to start again"
            ) from error
        return none | dict(zip(counts, bits, strict=True))
    masks = choose(kept)
    kept.keep_own(SUBSETS, {"masks": np.packbits(np.stack(masks), axis=1)})
    (kept.folder / ROUNDS).unlink(missing_ok=True)
    return none | dict(zip(counts, masks, strict=True))


def frozen_sizes(sizes: list[tuple[int, int, int]]) -> list[int]:
    """Return the distinct numbers of frozen Gaussians above 0 in `LevelsConfig.sizes`, descending."""
    return sorted({frozen for _, frozen, _ in sizes} - {0}, reverse=True)


def _halve(cameras: Cameras) -> Cameras:
    """Return the same cameras at half the size, which is enough for choosing and faster."""
    width = max(cameras.width // 2, 1)
    height = max(cameras.height // 2, 1)
    scale = np.array([width / cameras.width, height / cameras.height, 1.0])
    return Cameras(cameras.viewmats, cameras.Ks * scale[:, None], width, height, cameras.names)
