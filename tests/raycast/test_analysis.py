from __future__ import annotations

import json
from dataclasses import fields, replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gsvis.errors import SceneError
from gsvis.raycast import (
    PAPER,
    Agreement,
    Analysis,
    AnalysisConfig,
    DirectionCdf,
    EllipsoidProxies,
    Tracer,
    analyze,
    directions,
    visible_in,
)
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.navigable import NavigableSpace
from gsvis.scene.procedural import OccluderScene, two_rooms

SMALL = AnalysisConfig(traced_sample=300, rays_per_face=1)


@cache
def rooms() -> OccluderScene:
    return two_rooms(2000, sh_degree=0)


@cache
def views(count: int = 8) -> Cameras:
    return rooms().navigable.sample_cameras(count, np.random.default_rng(1), width=24, height=18)


@cache
def analysis() -> Analysis:
    return analyze(rooms().gaussians, views(), SMALL, navigable=rooms().navigable)


def test_both_tracers_see_the_same_in_the_same_views() -> None:
    ours = analyze(rooms().gaussians, views(3), replace(SMALL, traced_sample=0))
    embree = analyze(rooms().gaussians, views(3), replace(SMALL, traced_sample=0, tracer="embree"))
    assert np.array_equal(embree.visible, ours.visible)
    assert np.array_equal(embree.gathered_sets, ours.gathered_sets)
    assert embree.as_dict()["config"]["tracer"] == "embree"


def lone_ball() -> Gaussians:
    return Gaussians(np.zeros((1, 3)), [[1, 0, 0, 0]], np.full((1, 3), 0.1), [0.9], np.zeros((1, 1, 3)))


def test_counts_are_those_of_the_cameras_one_by_one() -> None:
    weights = visible_in(Tracer(EllipsoidProxies.from_scene(rooms().gaussians)), views())
    expected = np.count_nonzero(weights >= np.float32(SMALL.tau), axis=1)
    assert np.array_equal(analysis().visible, expected)
    assert np.array_equal(analysis().visible_fractions, expected / len(rooms().gaussians))
    seen = np.any(weights >= np.float32(SMALL.tau), axis=0)
    assert np.array_equal(analysis().gathered_sets.any(axis=1), seen)
    assert analysis().gathered.seen == np.count_nonzero(seen)


def test_sets_are_gathered_over_all_cameras_whatever_their_order() -> None:
    tracer = Tracer(EllipsoidProxies.from_scene(rooms().gaussians))
    assert np.array_equal(analysis().gathered_sets, directions.directions_from_cameras(tracer, views(), SMALL.tau))
    other = analyze(rooms().gaussians, views()[::-1], AnalysisConfig(traced_sample=0, seed=9), tracer=tracer)
    assert np.array_equal(other.gathered_sets, analysis().gathered_sets)
    assert np.array_equal(other.visible[::-1], analysis().visible)


def test_settling_goes_through_doublings_and_ends_with_all() -> None:
    steps = analysis().settling
    assert [step.cameras for step in steps] == [1, 2, 4, 8]
    assert steps[-1].below_33_of_all == analysis().gathered.below(33)
    assert steps[-1].mean_faces == pytest.approx(80 * directions.direction_fractions(analysis().gathered_sets).mean())
    assert [step.seen for step in steps] == sorted(step.seen for step in steps)
    assert steps[0].change is None
    assert all(step.change is not None and 0.0 <= step.change <= 1.0 for step in steps[1:])
    assert not analysis().has_settled


@pytest.mark.parametrize(("count", "stops"), [(1, [1]), (2, [1, 2]), (3, [1, 2, 3]), (5, [1, 2, 3, 5])])
def test_few_cameras_have_few_steps(count: int, stops: list[int]) -> None:
    found = analyze(lone_ball(), Cameras.orbit((0, 0, 0), 2.0, count, width=8, height=8), AnalysisConfig())
    assert [step.cameras for step in found.settling] == stops


def test_a_ball_seen_from_all_around_is_seen_from_all_faces() -> None:
    eyes = directions.face_directions().reshape(-1, 3) * 3.0
    found = analyze(lone_ball(), Cameras.look_at(eyes, (0, 0, 0), width=4, height=4, fov=20), AnalysisConfig())
    assert found.gathered.values[79] == 0.0  # nothing is seen from fewer than all 80 faces
    assert found.gathered.mean_faces == 80.0
    assert not found.has_settled  # the last camera mattered as much as the first
    assert found.traced is None
    assert "navigable" in found.untraced_because


@pytest.mark.parametrize(
    ("cameras", "change", "settled"), [(80, 0.019, True), (80, 0.02, False), (79, 0.0, False), (4000, 0.0, True)]
)
def test_settled_means_many_cameras_of_which_half_would_do(cameras: int, change: float, settled: bool) -> None:
    half, last = analysis().settling[-2:]
    steps = (replace(half, cameras=cameras), replace(last, cameras=2 * cameras, change=change))
    assert replace(analysis(), settling=steps).has_settled == settled


def test_a_ball_in_open_space_is_traced_to_all_sides() -> None:
    space = NavigableSpace.from_box((-2, -2, -2), (2, 2, 2), 8)
    found = analyze(lone_ball(), Cameras.orbit((0, 0, 0), 1.5, 3, width=8, height=8), SMALL, navigable=space)
    assert found.traced is not None
    assert found.traced.mean_faces == 80.0
    assert found.agreement is not None
    assert found.agreement.mean_jaccard == pytest.approx(3 / 80)
    assert found.agreement.gathered_confirmed == 1.0
    assert found.agreement.traced_confirmed == pytest.approx(3 / 80)


def test_the_sample_is_seeded_sorted_and_without_repeats() -> None:
    again = analyze(rooms().gaussians, views(), SMALL, navigable=rooms().navigable)
    assert np.array_equal(again.sample, analysis().sample)
    assert np.array_equal(again.traced_sets, analysis().traced_sets)
    assert np.all(np.diff(again.sample) > 0)
    assert len(again.sample) == 300
    other = AnalysisConfig(traced_sample=10**6, seed=1, rays_per_face=1)
    assert len(analyze(lone_ball(), views()[:1], other, navigable=rooms().navigable).sample) == 1


@given(st.lists(st.integers(0, 80), min_size=1, max_size=30), st.integers(1, 80))
def test_below_counts_strictly_fewer_faces(counts: list[int], limit: int) -> None:
    bits = np.arange(80)[None, :] < np.asarray(counts)[:, None]
    cdf = DirectionCdf.from_sets(np.packbits(bits, axis=1, bitorder="little"))
    assert cdf.below(limit) == pytest.approx(np.mean([count < limit for count in counts]))
    seen = [count for count in counts if count]
    assert cdf.seen == len(seen)
    expected = np.mean([count < limit for count in seen]) if seen else 1.0
    assert cdf.below(limit, of_seen=True) == pytest.approx(expected)
    assert cdf.mean_faces == pytest.approx(np.mean(counts))


def test_agreement_of_equal_disjoint_and_empty_sets() -> None:
    one, other = np.zeros((2, 10), np.uint8), np.zeros((2, 10), np.uint8)
    assert Agreement.from_sets(one, other) == Agreement(1.0, 1.0, 1.0, 1.0)
    one[0, 0] = 0b11
    assert Agreement.from_sets(one, one) == Agreement(1.0, 1.0, 1.0, 1.0)
    other[0, 0] = 0b100
    assert Agreement.from_sets(one, other) == Agreement(0.5, 0.0, 0.0, 0.0)
    other[0, 0] = 0b001
    assert Agreement.from_sets(one, other) == Agreement(0.75, 0.5, 0.5, 1.0)


def test_the_field_of_view_is_the_one_of_the_cameras() -> None:
    assert analysis().field_of_view == pytest.approx((60.0, 60.0))


def test_as_dict_is_plain_json_with_the_papers_figures() -> None:
    document = json.loads(json.dumps(analysis().as_dict(), allow_nan=False))
    assert document["paper"] == dict(PAPER)
    assert document["visible_fraction"]["min"] <= document["visible_fraction"]["mean"]
    assert [each["name"] for each in document["visible_fraction"]["cameras"]] == list(views().names)
    assert document["rays"] == {"width": 24, "height": 18, "horizontal_fov_degrees": pytest.approx([60.0, 60.0])}
    assert len(document["directions"]["gathered"]["cdf_of_all"]) == 81
    assert document["directions"]["traced"]["gaussians"] == 300


def test_progress_runs_through_its_stages_and_may_stop_the_work() -> None:
    calls: list[tuple[str, int, int]] = []
    g = rooms().gaussians
    analyze(g, views(2), SMALL, navigable=rooms().navigable, progress=lambda *call: calls.append(call))
    assert list(dict.fromkeys(stage for stage, _, _ in calls)) == [
        "structure",
        "cameras",
        "check",
        "directions",
        "angles",
    ]
    for stage in ("structure", "cameras", "check", "directions"):
        done = [(d, t) for s, d, t in calls if s == stage]
        assert done[0][0] == 0
        assert done[-1][0] == done[-1][1]

    def stop(stage: str, done: int, total: int) -> None:
        if stage == "cameras" and done == 1:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        analyze(g, views(2), SMALL, progress=stop)


def test_refusals_name_the_argument() -> None:
    with pytest.raises(SceneError, match="no Gaussian"):
        analyze(Gaussians.empty(), views())
    with pytest.raises(ValueError, match="cameras: expected at least one"):
        analyze(lone_ball(), views()[:0])
    with pytest.raises(ValueError, match="tracer: expected"):
        analyze(lone_ball(), views(), tracer=Tracer(EllipsoidProxies.from_scene(lone_ball())))


@pytest.mark.parametrize(
    ("name", "value"),
    [("tau", 0.0), ("tau", float("nan")), ("traced_sample", -1), ("rays_per_face", 2), ("seed", -1), ("seed", 1.5)],
)
def test_a_config_out_of_range_is_refused_by_name(name: str, value: Any) -> None:
    assert name in {each.name for each in fields(AnalysisConfig)}
    with pytest.raises(ValueError, match=f"{name}: expected"):
        AnalysisConfig(**{name: value})
