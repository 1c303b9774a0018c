"""Levels of a scene: how large, what they share, that training repairs, that a killed run goes on to the same bits."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gsvis.errors import FormatError
from gsvis.scene.cameras import Cameras
from gsvis.scene.facts import SceneFacts
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.levels import Levels
from gsvis.train.choosing import LOOKS
from gsvis.train.images import PosedImages, render_views
from gsvis.train.importance import rank_by_error
from gsvis.train.levels import LevelsConfig, TrainedLevels, _slowed, train_levels
from gsvis.train.likeness import mean_psnr
from gsvis.train.trainer import TrainConfig

COUNT = 300
CONFIG = LevelsConfig(shares=(0.12, 0.25), iterations=60, threshold=1e-5, most_share=0.02, evaluate_every=20)
BRIEF = replace(CONFIG, iterations=6, evaluate_every=0)


def made(seed: int = 3, degree: int = 1) -> Gaussians:
    rng = np.random.default_rng(seed)
    return Gaussians(
        rng.uniform(-1, 1, (COUNT, 3)),
        rng.normal(size=(COUNT, 4)),
        rng.uniform(0.08, 0.3, (COUNT, 3)),
        rng.uniform(0.2, 0.95, COUNT),
        rng.uniform(-1, 1, (COUNT, 1, 3)),
        rng.uniform(-0.2, 0.2, (COUNT, (degree + 1) ** 2 - 1, 3)),
    )


@pytest.fixture(scope="module")
def scene() -> Gaussians:
    return made()


@pytest.fixture(scope="module")
def views(scene: Gaussians) -> PosedImages:
    return render_views(scene, Cameras.orbit((0, 0, 0), 4.0, 8, width=24, height=20))


@pytest.fixture(scope="module")
def held_out(scene: Gaussians) -> PosedImages:
    return render_views(scene, Cameras.orbit((0, 0, 0), 3.7, 3, elevation=35.0, width=24, height=20))


def test_a_preview_begins_with_merges_where_others_clone(scene: Gaussians, views: PosedImages) -> None:
    config = replace(BRIEF, merged=0.0, preview=0.02, preview_from=1)
    total, frozen, begun = config.sizes(COUNT)[0]
    assert (frozen, begun) == (0, total)
    levels = train_levels(scene, views, config).levels
    assert levels.names[0] == "preview"
    assert 1 < len(levels.level(0)) <= total


@pytest.fixture(scope="module")
def trained(scene: Gaussians, views: PosedImages, held_out: PosedImages) -> TrainedLevels:
    return train_levels(scene, views, CONFIG, held_out=held_out)


@pytest.fixture(scope="module")
def brief(scene: Gaussians, views: PosedImages) -> Levels:
    return train_levels(scene, views, BRIEF).levels


def same(a: Gaussians, b: Gaussians) -> bool:
    return all(np.array_equal(getattr(a, name), getattr(b, name)) for name in vars(a))


def equal(a: Levels, b: Levels) -> bool:
    return (
        same(a.union, b.union)
        and np.array_equal(a.first, b.first)
        and np.array_equal(a.last, b.last)
        and a.names == b.names
    )


def frozen_of(levels: Levels, level: int) -> np.ndarray:
    """Mask over the union of what a level shares with the next."""
    return levels.member(level) & levels.member(level + 1)


def test_levels_are_no_larger_than_asked_and_share_at_least_as_much(trained: TrainedLevels) -> None:
    levels = trained.levels
    assert levels.names == CONFIG.names
    assert levels.counts[-1] == COUNT
    for k, (share, reuse) in enumerate(zip(CONFIG.shares, CONFIG.reuse, strict=True)):
        assert levels.counts[k] <= share * COUNT
        assert levels.reuse[k] >= reuse
        assert frozen_of(levels, k).sum() == CONFIG.sizes(COUNT)[k][1]


def test_levels_of_the_paper_keep_what_equation_6_ranks_first_and_grow_by_clones(
    scene: Gaussians, views: PosedImages
) -> None:
    config = replace(CONFIG, importance="gradient", merged=0.0, evaluate_every=0)
    levels = train_levels(scene, views, config).levels
    sizes = config.sizes(COUNT)
    chosen = rank_by_error(scene, views, [sizes[1][1], sizes[0][1]], photographs=True)
    for k, mask in ((1, chosen[0]), (0, chosen[1])):
        assert np.array_equal(frozen_of(levels, k)[:COUNT], mask)
        most = 1 + (config.iterations // 4) * max(1, int(config.most_share * sizes[k][0]))
        own = levels.member(k)[COUNT:].sum()
        assert 1 <= own <= min(sizes[k][0] - sizes[k][1], most)
        grown = levels.union[COUNT:][levels.member(k)[COUNT:]]
        assert grown.scales.max() < 3.0 * scene.scales.max()  # none stands for all that the level lacks
    with pytest.raises(ValueError, match="importance: expected one of"):
        LevelsConfig(importance="weight")


def test_the_union_begins_with_the_scene_and_frozen_ones_are_its_own_to_the_bit(
    scene: Gaussians, trained: TrainedLevels
) -> None:
    levels = trained.levels
    assert same(levels.union[:COUNT], scene)
    assert same(levels.level(2), scene)
    for k in range(2):
        shared = frozen_of(levels, k)
        assert not shared[COUNT:].any()
        low = levels.level(k)
        stands = shared[levels.member(k)]
        assert same(low[stands], scene[shared[:COUNT]])


def test_a_first_picture_is_merges_alone_and_changes_no_other_level(
    scene: Gaussians, views: PosedImages, brief: Levels
) -> None:
    levels = train_levels(scene, views, replace(BRIEF, preview=0.05, preview_from=COUNT)).levels
    assert levels.names == ("preview", *brief.names)
    assert levels.counts[0] == COUNT // 20
    assert levels.reuse[0] == 0.0
    assert (levels.previews, brief.previews) == (1, 0)
    assert not levels.member(0)[:COUNT].any()
    for k in range(len(brief)):
        assert same(levels.level(k + 1), brief.level(k))


def test_only_a_scene_that_is_large_enough_has_a_first_picture() -> None:
    config = LevelsConfig(preview=0.05, preview_from=1000)
    assert config.fit_to(1000) == config
    assert config.level_names == ("preview", *config.names)
    assert [total for total, _, _ in config.sizes(1000)] == [50, 250, 500]
    assert config.sizes(1000)[0] == (50, 0, 50)
    assert config.fit_to(999).level_names == config.names
    assert [total for total, _, _ in config.sizes(999)] == [249, 499]
    small = replace(config, shares=(0.1, 0.5))  # a first picture itself
    assert small.fit_to(1000).level_names == config.names
    assert replace(config, preview=0.0).level_names == config.names


def test_what_is_kept_is_nested_and_what_a_level_has_of_its_own_is_nowhere_else(trained: TrainedLevels) -> None:
    levels = trained.levels
    low, medium = frozen_of(levels, 0), frozen_of(levels, 1)
    assert (low <= medium).all()
    own = np.arange(len(levels.union)) >= COUNT
    assert np.array_equal(levels.first[own], levels.last[own])
    assert (levels.last[~own] == 2).all()


def test_going_up_sends_what_levels_have_of_their_own_beyond_the_scene(trained: TrainedLevels) -> None:
    levels = trained.levels
    own = sum(count - int(frozen_of(levels, k).sum()) for k, count in enumerate(levels.counts[:-1]))
    assert levels.overhead == pytest.approx(own / COUNT)
    most = sum((1.0 - r) * s for r, s in zip(CONFIG.reuse, CONFIG.shares, strict=True))
    assert levels.overhead <= most + 1e-9


def test_a_level_looks_more_like_the_scene_than_what_it_keeps_alone(
    trained: TrainedLevels, views: PosedImages, held_out: PosedImages
) -> None:
    levels = trained.levels
    for k, name in enumerate(CONFIG.names[:2]):
        kept = levels.union[frozen_of(levels, k)]
        assert mean_psnr(levels.level(k), views) > mean_psnr(kept, views) + 0.3
        history = trained.histories[name]
        assert [record.step for record in history] == [20, 40, 60]
        assert history[-1].count == levels.counts[k]
        assert history[-1].psnr == pytest.approx(mean_psnr(levels.level(k), held_out), abs=1e-6)
    assert mean_psnr(levels.level(1), views) > mean_psnr(levels.level(0), views)


def test_the_same_seed_gives_the_same_bits_and_photographs_serve_as_well(
    scene: Gaussians, views: PosedImages, brief: Levels
) -> None:
    assert equal(train_levels(scene, views, BRIEF).levels, brief)
    photographs = PosedImages(views.cameras, (views.images.clip(0, 1) * 255).round().astype(np.uint8))
    levels = train_levels(scene, photographs, BRIEF).levels
    assert same(levels.union[:COUNT], scene)
    assert levels.reuse[0] >= 0.9


def test_levels_that_keep_everything_have_nothing_to_train(scene: Gaussians, views: PosedImages) -> None:
    stages: set[str] = set()
    whole = replace(BRIEF, reuse=(1.0, 1.0))
    found = train_levels(scene, views, whole, progress=lambda stage, done, of: stages.add(stage))
    assert stages == {"prune"}
    assert same(found.levels.union, scene)
    assert found.levels.counts == (36, 75, COUNT)
    assert (found.levels.reuse, found.levels.overhead) == ((1.0, 1.0), 0.0)
    assert found.histories == {"low": [], "medium": []}


def test_levels_that_reuse_nothing_need_no_choice(scene: Gaussians, views: PosedImages) -> None:
    stages: set[str] = set()
    free = replace(BRIEF, reuse=(0.0, 0.0), iterations=2)
    found = train_levels(scene, views, free, progress=lambda stage, done, of: stages.add(stage))
    assert "prune" not in stages
    assert found.levels.counts == (36, 75, COUNT)
    assert found.levels.reuse == (0.0, 0.0)
    with pytest.raises(ValueError, match=r"reuse: expected shares in \[0, 1\], got -0.1"):
        replace(BRIEF, reuse=(-0.1, 0.5))


@pytest.mark.parametrize("shares", [(0.1,), (0.1, 0.3, 0.31, 0.9)])
def test_there_may_be_any_number_of_levels(scene: Gaussians, views: PosedImages, shares: tuple[float, ...]) -> None:
    names = tuple("abcde"[: len(shares) + 1])
    config = replace(BRIEF, shares=shares, reuse=(0.8,) * len(shares), names=names)
    levels = train_levels(scene, views, config).levels
    assert levels.names == names
    assert all(count <= share * COUNT for count, share in zip(levels.counts, shares, strict=False))
    assert all(reuse >= 0.8 for reuse in levels.reuse)


def test_views_that_show_nothing_do_no_harm(scene: Gaussians) -> None:
    away = Cameras.look_at([(0, 0, 9), (0, 0, 8)], (0, 0, 20), up=(0, 1, 0), fov=60, width=24, height=20)
    levels = train_levels(scene, render_views(scene, away), BRIEF).levels
    assert same(levels.union[:COUNT], scene)


def test_colors_without_bands_stay_so(views: PosedImages) -> None:
    plain = made(degree=0)
    assert train_levels(plain, views, BRIEF).levels.union.sh_degree == 0


def test_what_is_known_of_a_scene_is_kept_and_an_origin_changes_no_bit(views: PosedImages) -> None:
    plain = made()
    known = SceneFacts(origin=(1e6, -2e6, 3.5), up=(0.0, 0.0, 1.0), up_source="a test", meters_per_unit=0.5)
    far = train_levels(plain.with_facts(known), views, BRIEF).levels
    assert far.union.facts == known
    assert equal(replace(far, union=far.union.with_facts(SceneFacts())), train_levels(plain, views, BRIEF).levels)


def test_levels_of_an_antialiased_scene_are_antialiased(views: PosedImages) -> None:
    known = SceneFacts(antialiased=True)
    assert train_levels(made().with_facts(known), views, BRIEF).levels.union.facts == known


def stopping(stage: str, at: int) -> Callable[[str, int, int], None]:
    def stop(name: str, done: int, total: int) -> None:
        if name == stage and done == at:
            raise KeyboardInterrupt

    return stop


@pytest.mark.parametrize(
    ("stage", "at"),
    [("prune", 0), ("prune", 20), ("train low", 0), ("train low", 4), ("train medium", 1), ("train medium", 6)],
)
def test_a_stopped_run_goes_on_to_the_same_bits(
    scene: Gaussians, views: PosedImages, brief: Levels, tmp_path: Path, stage: str, at: int
) -> None:
    with pytest.raises(KeyboardInterrupt):
        train_levels(scene, views, BRIEF, work=tmp_path, progress=stopping(stage, at))
    assert not [path.name for path in tmp_path.iterdir() if path.name.startswith(".")]  # nothing half-written
    calls: list[tuple[str, int]] = []
    again = train_levels(scene, views, BRIEF, work=tmp_path, progress=lambda *call: calls.append(call[:2]))
    assert equal(again.levels, brief)
    if stage != "prune":
        assert "prune" not in {name for name, _ in calls}
        assert next(done for call, done in calls if call == stage) == at


def test_a_finished_run_is_not_worked_out_again(
    scene: Gaussians, views: PosedImages, brief: Levels, tmp_path: Path
) -> None:
    first = train_levels(scene, views, BRIEF, work=tmp_path / "new" / "work")
    calls: list[tuple[str, int, int]] = []
    again = train_levels(scene, views, BRIEF, work=tmp_path / "new" / "work", progress=lambda *call: calls.append(call))
    assert calls == [("train low", 6, 6), ("train medium", 6, 6)]
    assert equal(first.levels, brief)
    assert equal(again.levels, brief)
    assert again.histories == first.histories or all(np.isnan(r.psnr) for r in again.histories["low"])


def test_other_cameras_may_choose(scene: Gaussians, views: PosedImages, brief: Levels, tmp_path: Path) -> None:
    below = Cameras.orbit((0, 0, 0), 3.0, 5, elevation=-60.0, width=16, height=12)
    other = train_levels(scene, views, replace(BRIEF, looks=3), choose_by=below, work=tmp_path).levels
    assert other.counts == brief.counts
    assert not np.array_equal(other.first, brief.first)
    with pytest.raises(ValueError, match=r"work: expected .* got work of a run with different ones"):
        train_levels(scene, views, replace(BRIEF, looks=3), work=tmp_path)


def test_work_of_another_run_is_refused(scene: Gaussians, views: PosedImages, tmp_path: Path) -> None:
    train_levels(scene, views, BRIEF, work=tmp_path)
    others: list[tuple[Gaussians, PosedImages, LevelsConfig]] = [
        (made(seed=4), views, BRIEF),
        (scene[:200], views, BRIEF),
        (scene, views[:5], BRIEF),
        (scene, views, replace(BRIEF, shares=(0.2, 0.5))),
        (scene, views, replace(BRIEF, prune_share=0.3)),
    ]
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    for other in others:
        with pytest.raises(
            ValueError, match=r"work: expected .* of the same input and settings, got work of a run with different ones"
        ):
            train_levels(*other, work=tmp_path)
    for change in ({"iterations": 7}, {"seed": 1}, {"merged": 0.5}):
        with pytest.raises(
            ValueError, match=r"checkpoint: expected .* got the checkpoint of a run with different ones"
        ):
            train_levels(scene, views, replace(BRIEF, **change), work=tmp_path)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


def damaged(path: Path, how: str) -> None:
    whole = path.read_bytes()
    if how in ("shape", "type", "sizes", "none"):
        with np.load(path) as archive:
            arrays = dict(archive)
        masks = arrays["masks"]
        changed = {"shape": masks[0], "type": masks.astype(np.float32), "sizes": masks | np.uint8(1)}
        arrays = {"key": arrays["key"], **({"masks": changed[how]} if how != "none" else {})}
        with path.open("wb") as file:
            np.savez(file, **arrays)
    elif how == "flipped":
        middle = whole.index(b"NUMPY", whole.index(b"masks.npy")) + 140
        path.write_bytes(whole[:middle] + bytes([whole[middle] ^ 255]) + whole[middle + 1 :])
    else:
        path.write_bytes({"cut": whole[: len(whole) // 2], "other": b"ply\nformat", "empty": b""}[how])


@pytest.mark.parametrize("how", ["cut", "other", "empty", "flipped", "shape", "type", "sizes", "none"])
def test_damaged_subsets_are_refused(scene: Gaussians, views: PosedImages, tmp_path: Path, how: str) -> None:
    with pytest.raises(KeyboardInterrupt):
        train_levels(scene, views, BRIEF, work=tmp_path, progress=stopping("train low", 0))
    damaged(tmp_path / "subsets.npz", how)
    with pytest.raises(FormatError, match=r"subsets\.npz.*delete it to start again"):
        train_levels(scene, views, BRIEF, work=tmp_path)


def test_what_cannot_be_done_is_refused_before_any_work(scene: Gaussians, views: PosedImages, tmp_path: Path) -> None:
    work = tmp_path / "work"
    with pytest.raises(ValueError, match="views: expected at least one image"):
        train_levels(scene, views[:0], BRIEF, work=work)
    with pytest.raises(ValueError, match=r"shares: expected at least 2 Gaussians in each level, got 0.12 of 7"):
        train_levels(scene[:7], views, BRIEF, work=work)
    assert not work.exists()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"shares": (0.0, 0.5)}, r"shares: expected shares in \(0, 1\], got 0.0"),
        ({"shares": (0.5, 1.5)}, r"shares: expected shares in \(0, 1\], got 1.5"),
        ({"shares": (-0.1, 0.5)}, "shares: expected shares in"),
        ({"shares": (float("nan"), 0.5)}, "shares: expected shares in"),
        ({"shares": (0.5, 0.25)}, "shares: .* a level cannot be larger than the one above it"),
        ({"shares": (0.5, 0.5)}, "shares: expected each below the next"),
        ({"shares": (0.5, 1.0)}, "shares: expected each below the next and the last below 1"),
        ({"shares": ()}, "shares: expected"),
        ({"reuse": (0.9,)}, "reuse: expected one for each of 2 shares, got 1"),
        ({"reuse": (-0.1, 0.9)}, "reuse: expected shares in"),
        ({"reuse": (0.9, 1.1)}, "reuse: expected shares in"),
        ({"reuse": (1.0, 0.3)}, "reuse: expected each level to keep more of the scene"),
        ({"names": ("low", "high")}, "names: expected 3 different ones"),
        ({"names": ("low", "low", "high")}, "names: expected 3 different ones"),
        ({"iterations": 0}, "iterations: expected"),
        ({"preview": 0.2}, "preview: expected a share in"),
        ({"names": ("preview", "medium", "high")}, "names: expected none that is 'preview'"),
        ({"preview_from": -1}, "preview_from: expected"),
        ({"merged": 1.5}, "merged: expected a share in"),
        ({"prune_share": 0.0}, "prune_share: expected a share in"),
        ({"prune_share": -0.5}, "prune_share: expected a share in"),
        ({"prune_share": 1.0}, "prune_share: expected a share in"),
        ({"looks": 0}, "looks: expected an integer of at least 1"),
        ({"threshold": 0.0}, "threshold: expected a finite number > 0"),
        ({"most_share": 0.0}, "most_share: expected a share in"),
        ({"seed": -1}, "seed: expected"),
        ({"evaluate_every": -1}, "evaluate_every: expected"),
    ],
)
def test_configurations_that_make_no_sense_are_refused(change: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        LevelsConfig(**change)


@pytest.mark.parametrize("count", [8, 9, 40, 41, 1000, 46_708])
@pytest.mark.parametrize("reuse", [(0.9, 0.96), (0.5, 0.55), (1.0, 1.0)])
def test_sizes_keep_what_is_asked_whatever_the_count(count: int, reuse: tuple[float, float]) -> None:
    config = LevelsConfig(reuse=reuse)
    for share, least, (total, frozen, begun) in zip(config.shares, reuse, config.sizes(count), strict=True):
        assert share * count - 1 < total <= share * count
        assert frozen - 1 + 1e-6 < least * total <= frozen + 1e-6  # one less would be too few
        assert frozen <= begun <= total
        assert (begun > frozen) == (total > frozen)


@pytest.mark.parametrize("iterations", [6, 400, 1000, 4000])
def test_levels_train_by_the_rules_of_the_paper(iterations: int) -> None:
    """Section 6.1: a higher threshold than from nothing, clones in place of splits, at most 1% at a time."""
    given = LevelsConfig(iterations=iterations).training(1000, 3)
    rules, usual = given.densify, TrainConfig().densify
    assert rules is not None
    assert usual is not None
    assert (rules.split, usual.split) == (False, True)
    assert rules.threshold > usual.threshold
    assert (rules.most_share, rules.most_count) == (0.01, 1000)
    assert rules.reset_every == 0, "a reset would dim what other levels share"
    assert (rules.start, rules.stop) == (0, 3 * iterations // 4), "the last quarter only settles"
    assert 1 <= rules.every <= min(100, max(iterations // 15, 1))
    assert (given.iterations, given.sh_degree, given.sh_every) == (iterations, 3, 0)
    assert given.means_rate_end < given.means_rate


def test_rates_fall_with_the_error_that_a_level_begins_with(scene: Gaussians, views: PosedImages) -> None:
    training = CONFIG.training(100, 1)

    def factor(begin: Gaussians) -> float:
        found = _slowed(training, begin, views)
        assert found.opacities_rate / training.opacities_rate == pytest.approx(found.means_rate / training.means_rate)
        assert found.rates_end == training.rates_end
        return found.means_rate / training.means_rate

    assert factor(scene) == pytest.approx(0.45)
    assert factor(scene[:2]) == 1.0
    dimmed = replace(scene, opacities=scene.opacities * np.float32(0.65))
    squared = np.mean([10.0 ** (-0.1 * mean_psnr(dimmed, views[k])) for k in range(len(views))])
    assert 0.45 < squared * 10.0**2.7 < 1.0
    assert factor(dimmed) == pytest.approx(squared * 10.0**2.7)


def test_looks_grow_with_the_root_of_the_steps_unless_they_are_asked_for() -> None:
    assert LevelsConfig().looks_to_choose == LOOKS
    assert LevelsConfig(iterations=100).looks_to_choose == LOOKS // 2
    assert LevelsConfig(iterations=1600).looks_to_choose == 2 * LOOKS
    assert LevelsConfig(iterations=1).looks_to_choose == 30
    assert LevelsConfig(iterations=1, looks=7).looks_to_choose == 7
