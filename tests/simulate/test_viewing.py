"""What is seen: pictures are those of the rasterizer, steps add up, latency is what it says."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gsvis.abr import AbrConfig, BandwidthTrace
from gsvis.render import rasterize
from gsvis.scene.cameras import Cameras
from gsvis.scene.paths import HeadPath
from gsvis.simulate import (
    Adaptive,
    Frame,
    Link,
    MortonProgressive,
    Playback,
    Stage,
    Viewing,
    ViewingConfig,
    WholeFile,
    play,
    watch,
)
from gsvis.stream import StreamedScene
from tests.simulate.streets import QUICK, street, walk

SLOW = Link(BandwidthTrace.constant(0.08), 0.04)  # 10,000 bytes a second


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[StreamedScene, Stage]]:
    scene, stage = street(tmp_path_factory.mktemp("street"))
    with scene.source:
        yield scene, stage


@pytest.fixture(scope="module")
def sessions(made: tuple[StreamedScene, Stage]) -> dict[str, Viewing]:
    scene, stage = made
    deliveries = (
        Adaptive(scene, QUICK.view, AbrConfig(start_rate=5e3)),
        WholeFile(scene.contents, 10_000),
        MortonProgressive(scene.contents),
    )
    played = [play(d, SLOW, walk(), stage.size, seconds=QUICK.watched) for d in deliveries]
    return {s.playback.name: s for s in watch(stage, played, walk(), QUICK)}


def camera() -> Cameras:
    return walk().resample(times=[0.7]).cameras(48, 36, 90.0)[0]


@settings(max_examples=10)
@given(st.integers(0, 1000))
def test_a_picture_is_what_the_rasterizer_draws(made: tuple[StreamedScene, Stage], seed: int) -> None:
    stage, rng = made[1], np.random.default_rng(seed)
    held, terms = rng.random(stage.size[0]) < rng.random(), rng.random(stage.size[1]) < rng.random()
    frame = Frame(stage, camera())
    assert stage.evaluator is not None
    ids = np.flatnonzero(held)
    eye = camera().viewpoints[0]
    colors = stage.evaluator.colors(stage.drawn.means, eye, active=terms, ids=ids)
    drawn = rasterize(stage.drawn[ids], camera(), colors=colors, backend="cpu").images[0].clip(0.0, 1.0)
    assert np.abs(frame.image(held[frame.ids], terms) - drawn).max() < 1e-6


def test_all_that_there_is_is_the_full_scene(made: tuple[StreamedScene, Stage]) -> None:
    stage = made[1]
    frame, every = Frame(stage, camera()), np.ones(stage.size[1], bool)
    assert frame.psnr(stage.highest[frame.ids], every) == np.inf
    assert 0.0 < frame.psnr(np.zeros(len(frame.ids), bool), every) < 40.0  # black


def test_the_scene_before_it_became_a_package_can_be_the_reference(made: tuple[StreamedScene, Stage]) -> None:
    stage = made[1]
    other = replace(stage, reference=stage.drawn[stage.highest])
    frame = Frame(other, camera())
    assert frame.psnr(stage.highest[frame.ids], np.zeros(stage.size[1], bool)) > 60.0
    assert "unquantized" in other.compared_with
    assert "decoded" in stage.compared_with


def test_a_whole_file_is_nothing_and_then_everything(sessions: dict[str, Viewing]) -> None:
    found = sessions["whole file"]
    there = 0.04 + 1.0
    assert np.array_equal(found.psnr, np.where(found.times >= there, QUICK.qoe.psnr_scale, 0.0))
    waited = np.clip(np.ceil((there - found.times) / 0.1 - 1e-6) * 0.1, 0.0, 1.0)
    assert np.allclose(found.latency, waited)
    assert found.figures()["seconds_to_first_image"] == found.figures()["seconds_to_good_image"] == 1.5
    assert found.figures()["records_twice"] == 0


def test_latency_is_the_first_tick_that_shows_the_pose(
    made: tuple[StreamedScene, Stage], sessions: dict[str, Viewing]
) -> None:
    stage, found = made[1], sessions["Morton order"]
    p = found.playback
    cameras = walk().resample(times=found.times).cameras(48, 36, 90.0)
    for k, t in enumerate(found.times.tolist()):
        frame, shown = Frame(stage, cameras[k]), []
        for tick in range(11):
            now = np.float32(t + 0.1 * tick + 1e-6)
            held = p.gaussian_at[frame.ids] <= now
            shown.append(now >= p.first and frame.psnr(held, p.term_at <= now) >= QUICK.qoe.shown_db)
        if shown == sorted(shown):  # more never showed less
            assert found.latency[k] == pytest.approx(min(shown.index(True) * 0.1, 1.0) if any(shown) else 1.0)


def test_a_viewer_waits_from_when_there_is_something_to_see(sessions: dict[str, Viewing]) -> None:
    """A walk that first looks into the void does not make a system slow."""
    found = next(iter(sessions.values()))
    late = replace(found, content=found.times >= 0.5, psnr=np.where(found.times >= 0.7, 40.0, 0.0))
    assert late.begins == 0.5
    first = found.times[found.times >= 0.7][0]
    assert late.time_of(35.0) == first
    assert late.seconds_to(35.0) == pytest.approx(first - 0.5)
    assert late.figures()["seconds_to_first_image"] == pytest.approx(first - 0.5)
    assert replace(late, content=np.zeros(len(late.times), bool)).seconds_to(20.0) == np.inf


def test_steps_stand_for_all_ticks(sessions: dict[str, Viewing]) -> None:
    found = sessions["gsvis"]
    assert found.times.tolist() == pytest.approx([*np.arange(10) / 10, 1.0, 1.5])
    assert found.weights.tolist() == [1] * 10 + [5, 5]
    assert found.qoe.score == pytest.approx(float(np.average(found.score, weights=found.weights)))
    assert found.qoe.steps == 20


def test_curves_rise_and_end_where_the_figures_say(sessions: dict[str, Viewing]) -> None:
    for found in sessions.values():
        record = found.as_dict()
        for name in ("bytes", "gaussian_share", "term_share"):
            curve = record["curves"][name]
            assert curve == sorted(curve)
            assert curve[-1] <= record["figures"][name] + 1e-4
        assert len({len(curve) for curve in record["curves"].values()}) == 1
        assert min(record["curves"]["psnr"]) == 0.0
        assert max(record["curves"]["psnr"]) <= 50.0


def test_what_is_served_first_is_what_is_in_view(
    made: tuple[StreamedScene, Stage], sessions: dict[str, Viewing]
) -> None:
    scene, stage = made
    config = AbrConfig(start_rate=5e3, fill=False)
    played = play(Adaptive(scene, QUICK.view, config), SLOW, walk(), stage.size, seconds=QUICK.watched)
    ours, curve = watch(stage, [played], walk(), QUICK)[0].figures(), sessions["Morton order"].figures()
    assert (ours["unseen_share"] or 0.0) < (curve["unseen_share"] or 0.0)
    assert not played.filling.any()


def test_playbacks_that_do_not_fit_are_refused(made: tuple[StreamedScene, Stage]) -> None:
    scene, stage = made
    short = play(MortonProgressive(scene.contents), SLOW, walk(), stage.size, seconds=1.0)
    with pytest.raises(ValueError, match="playbacks: expected at least 3 seconds"):
        watch(stage, [short], walk(), QUICK)
    other = Playback(**{**vars(short), "seconds": 3.0, "term_at": short.term_at[:-1]})
    with pytest.raises(ValueError, match="terms, as the scene has, got"):
        watch(stage, [other], walk(), QUICK)


@pytest.mark.parametrize(
    "wrong", [{"seconds": 0.0}, {"tick": np.nan}, {"fine": -1.0}, {"width": 0}, {"fov": 180.0}, {"margin": 90.0}]
)
def test_settings_out_of_range_are_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match="expected"):
        ViewingConfig(**wrong)


def away(path: HeadPath) -> HeadPath:
    """The same walk a long way off, where nothing of the scene is in sight."""
    return HeadPath(path.times, path.positions + np.array([0.0, 1e4, 0.0]), path.quats, path.up)


def test_a_path_that_sees_nothing_has_no_figures(made: tuple[StreamedScene, Stage]) -> None:
    scene, stage = made
    path = away(walk())
    deliveries = (Adaptive(scene, QUICK.view), WholeFile(scene.contents, 10_000))
    played = [play(d, SLOW, path, stage.size, seconds=QUICK.watched) for d in deliveries]
    for session in watch(stage, played, path, QUICK):
        assert not session.content.any()
        figures = session.figures()
        for name in ("score", "psnr", "latency", "stall", "seconds_to_first_image", "seconds_to_good_image"):
            assert figures[name] is None
        assert figures["bytes"] >= 0.0
        with pytest.raises(ValueError, match="at least one step"):
            _ = session.qoe


def test_views_without_content_count_in_no_figure(sessions: dict[str, Viewing]) -> None:
    session = sessions["gsvis"]
    assert session.content.all()
    content = session.times >= 0.5
    part = replace(session, content=content)
    spoilt = replace(part, psnr=np.where(content, session.psnr, 50.0), latency=np.where(content, session.latency, 0.0))
    for key, value in part.figures().items():
        assert value == spoilt.figures()[key]
    assert part.qoe.score == pytest.approx(float(np.average(session.score, weights=session.weights * content)))


def test_content_is_what_black_would_not_pass_for(made: tuple[StreamedScene, Stage]) -> None:
    frame = Frame(made[1], camera())
    for level, seen in ((0.09, False), (0.11, True)):
        frame.reference = np.full_like(frame.reference, level)
        assert frame.has_content is seen
