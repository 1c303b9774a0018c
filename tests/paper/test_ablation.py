"""Our stream without one of its ideas: what is left out is gone, and the rest works."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from paper.ablation import ABLATIONS, ablated, without_levels, without_sets, without_terms

from gsvis.abr import AbrConfig, BandwidthTrace
from gsvis.simulate import Adaptive, Link, Playback, play
from gsvis.stream import StreamedScene
from tests.simulate.streets import QUICK, street, walk

FAST = Link(BandwidthTrace.constant(50.0), 0.04)


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Iterator[StreamedScene]:
    made = street(tmp_path_factory.mktemp("ablation"))[0]
    with made.source:
        yield made


def played(delivery: Adaptive, scene: StreamedScene) -> Playback:
    size = len(scene.contents), len(scene.contents.term_records)
    return play(delivery, FAST, walk(), size, seconds=3.0)


def test_without_sets_every_cell_sees_everything(scene: StreamedScene) -> None:
    other = without_sets(scene)
    for cell in range(len(other.index.grid)):
        assert len(other.index.sets.classes(cell)[0]) == len(scene)
    p = played(ablated(other, "sets", QUICK.view, AbrConfig(fill=False)), scene)
    highest = scene.contents.last == len(scene.contents.names) - 1
    assert np.isfinite(p.gaussian_at[highest]).all()
    assert p.name == "gsvis without sets"


def test_without_levels_only_the_highest_is_sent(scene: StreamedScene) -> None:
    p = played(ablated(without_levels(scene), "levels", QUICK.view), scene)
    highest = scene.contents.last == len(scene.contents.names) - 1
    assert np.isfinite(p.gaussian_at[highest]).all()  # what no cell sees, too
    assert not np.isfinite(p.gaussian_at[~highest]).any()
    assert not np.isfinite(p.gone_at).any()
    owners = np.repeat(np.arange(len(scene.contents)), scene.contents.term_counts)
    assert np.isfinite(p.gaussian_at[owners][np.isfinite(p.term_at)]).all()


def test_without_terms_coefficients_come_with_each_gaussian(scene: StreamedScene) -> None:
    delivery = ablated(without_terms(scene, 20.0), "terms", QUICK.view, sh_bytes=20.0)
    p = played(delivery, scene)
    owners = np.repeat(np.arange(len(scene.contents)), scene.contents.term_counts)
    assert np.array_equal(p.gaussian_at[owners], p.term_at)
    count = np.isfinite(p.gaussian_at).sum()
    assert p.sizes.sum() >= count * 36
    assert p.twice == 0


def test_without_prediction_nothing_is_looked_ahead(scene: StreamedScene) -> None:
    about = ablated(scene, "prediction", QUICK.view).describe()
    assert (about["predictor"], about["lead"], about["ahead"]) == ("last", 0.0, 0.0)


def test_the_scene_itself_is_unchanged(scene: StreamedScene) -> None:
    before = played(Adaptive(scene, QUICK.view), scene)
    for make in (without_sets, without_levels, lambda s: without_terms(s, 20.0)):
        assert make(scene).contents is scene.contents
    after = played(Adaptive(scene, QUICK.view), scene)
    assert np.array_equal(before.gaussian_at, after.gaussian_at)


def test_what_cannot_be_left_out_is_refused(scene: StreamedScene) -> None:
    with pytest.raises(ValueError, match="left_out"):
        ablated(scene, "gravity", QUICK.view)
    with pytest.raises(ValueError, match="sh_bytes"):
        without_terms(scene, -1.0)
    assert set(ABLATIONS) == {"sets", "levels", "terms", "prediction"}
