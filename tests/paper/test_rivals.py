"""Rivals: everything is sent once, nothing before its request, what is in view comes first, bytes are those stated."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise

import numpy as np
import pytest
from paper.rivals import RIVALS, Layers, LeafFiles, Measured, Pieces, Sender, rival
from paper.rivals.flow import Files, Window
from paper.rivals.leaves import LeafStream
from paper.rivals.pieces import boxes_in_view, boxes_of, distances_to
from paper.rivals.segments import Segments, layers_by_importance, level_files, level_layers

from gsvis.abr import BandwidthTrace, FieldOfView, Pose
from gsvis.package.contents import Contents
from gsvis.simulate import Link, Playback, Stage, WholeFile, play, watch
from gsvis.simulate.baselines import terms_of
from gsvis.simulate.delivery import Parcel
from gsvis.stream import StreamedScene
from tests.simulate.streets import QUICK, street, walk

FAST = Link(BandwidthTrace.constant(50.0), 0.04)
SLOW = Link(BandwidthTrace.constant(0.2), 0.1)
BYTES = 40.0
STILL = np.array([1.0, 0.0, 0.0, 0.0])  # looks along +z


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Iterator[StreamedScene]:
    made = street(tmp_path_factory.mktemp("rivals"))[0]
    with made.source:
        yield made


@pytest.fixture(scope="module")
def measured(scene: StreamedScene) -> Measured:
    contents = scene.contents
    of = np.argsort(np.argsort(contents.gaussians().means[:, 0])) * 5 // len(contents)  # five slabs along x
    counts = [[np.sum(member & (of == b)) for b in range(5)] for member in members(contents)]
    return Measured(contents, LeafFiles(of, 30 * np.array(counts), 500, np.zeros(0, np.int64)), BYTES, BYTES, BYTES, 64)


def members(contents: Contents) -> list[np.ndarray]:
    first, last = contents.first, contents.last
    return [(first <= k) & (k <= last) for k in range(len(contents.names))]


def played(name: str, measured: Measured, link: Link = FAST, seconds: float = 4.0) -> Playback:
    contents = measured.contents
    size = len(contents), len(contents.term_records)
    return play(rival(name, measured, QUICK.view), link, walk(), size, seconds=seconds)


def drain(sender: Sender, t: float) -> list[Parcel]:
    found = []
    while (parcel := sender.next(t)) is not None:
        found.append(parcel)
    return found


@pytest.mark.parametrize("name", RIVALS)
def test_everything_comes_once_and_bytes_are_those_stated(name: str, measured: Measured) -> None:
    p, contents = played(name, measured), measured.contents
    assert p.twice == 0
    assert np.all(np.diff(p.times) >= 0)
    shown = np.isfinite(p.gaussian_at) & ~np.isfinite(p.gone_at)
    owners = np.repeat(np.arange(len(contents)), contents.term_counts)
    assert np.array_equal(np.isfinite(p.term_at), np.isfinite(p.gaussian_at)[owners])
    if name not in ("leaves, playcanvas", "leaves, octree-gs"):  # those stop at the level of the distance
        assert np.array_equal(shown, contents.last == len(contents.names) - 1)
        assert p.sizes.sum() == p.about["bytes"]
    else:
        assert 0 < p.sizes.sum() <= p.about["bytes"]


@pytest.mark.parametrize("name", RIVALS)
def test_nothing_is_sent_before_it_is_asked_for(name: str, measured: Measured) -> None:
    delivery = rival(name, measured, QUICK.view)
    assert delivery.next(0.0) is None
    p = played(name, measured, SLOW)
    assert p.first >= 0.1
    if name.startswith("leaves"):  # the description of the tree costs a round trip of its own
        assert p.first >= 0.2 + 500 / 25e3
    for t in (0.5, 1.0, 3.0):
        assert p.bytes_at(t) <= 25e3 * t


@pytest.mark.parametrize("name", RIVALS)
def test_the_same_session_gives_the_same_arrivals(name: str, measured: Measured) -> None:
    first, second = played(name, measured, SLOW, 1.0), played(name, measured, SLOW, 1.0)
    assert np.array_equal(first.gaussian_at, second.gaussian_at)


def test_an_unknown_rival_is_refused(measured: Measured) -> None:
    with pytest.raises(ValueError, match="frustum chunks"):
        rival("sorcery", measured, QUICK.view)


def test_a_level_replaces_what_it_does_not_share(measured: Measured) -> None:
    p, contents = played("leaves, spark", measured), measured.contents
    replaced = np.flatnonzero((contents.last < len(contents.names) - 1) & np.isfinite(p.gaussian_at))
    assert len(replaced)
    assert np.isfinite(p.gone_at[replaced]).all()
    assert (p.gone_at[replaced] >= p.gaussian_at[replaced]).all()


@pytest.mark.parametrize("rule", ["playcanvas", "spark", "octree-gs"])
def test_levels_of_a_leaf_come_in_order(rule: str, measured: Measured) -> None:
    p, contents = played(f"leaves, {rule}", measured, SLOW), measured.contents
    for leaf in range(5):
        inside = measured.files.of == leaf
        starts = [p.gaussian_at[inside & (contents.first == k)].min(initial=np.inf) for k in range(3)]
        assert starts == sorted(starts)


def test_playcanvas_wants_less_of_what_is_far(measured: Measured) -> None:
    stream = LeafStream(measured.contents, measured.files, QUICK.view, "playcanvas")
    drained: list[int] = []
    middle = measured.segments.boxes.mean(axis=(0, 1))
    reach = np.ptp(measured.segments.boxes, axis=(0, 1)).max()
    for away in (0.0, reach + 10.0, reach + 1000.0):
        eye = middle - [0.0, 0.0, away]
        wanted = np.isfinite(stream.urgency(0.0, Pose.from_arrays(eye, STILL))).reshape(3, 5)
        assert np.array_equal(wanted, np.sort(wanted, axis=0)[::-1])  # lower levels before higher ones
        drained.append(int(wanted.sum()))
    assert drained[0] > drained[1] > drained[2] == 5  # the coarsest level is always wanted


def test_spark_asks_for_the_nearer_and_for_what_is_ahead(measured: Measured) -> None:
    stream = LeafStream(measured.contents, measured.files, QUICK.view, "spark")
    middle = stream._boxes.mean(axis=1)
    eye = middle[2] - [0.0, 0.0, 500.0]  # far along the axis: all leaves ahead
    ahead = stream.urgency(0.0, Pose.from_arrays(eye, STILL))
    behind = stream.urgency(0.1, Pose.from_arrays(eye, [0.0, 1.0, 0.0, 0.0]))  # looks back
    np.testing.assert_allclose(behind, 0.2 * ahead, rtol=1e-6)
    further = stream.urgency(0.2, Pose.from_arrays(eye - [0.0, 0.0, 500.0], STILL))
    assert (further < ahead).all()


def test_chunks_in_view_come_before_those_out_of_view(measured: Measured) -> None:
    view = FieldOfView.from_degrees(40, 40)
    delivery = rival("frustum chunks", measured, view)
    assert isinstance(delivery, Sender)
    delivery._flow = Files(1000)
    position = np.array([-50.0, 0.0, -40.0])
    delivery.on_pose(0.0, position, STILL)
    parcels = drain(delivery, 0.0)
    g = measured.contents.gaussians()
    groups = [parcel.gaussians for parcel in parcels if len(parcel.gaussians)]
    boxes = boxes_of(g.means, g.scales, groups)
    inside = boxes_in_view(view.planes(position, STILL), boxes)
    assert np.array_equal(inside, np.sort(inside)[::-1])
    for part in (inside, ~inside):
        assert np.all(np.diff(distances_to(position, boxes[part])) >= -1e-9)


def test_utility_prefers_what_is_in_view_and_near(measured: Measured) -> None:
    segments = measured.segments
    along_x = np.array([np.sqrt(0.5), 0.0, np.sqrt(0.5), 0.0])
    delivery = Layers(measured.contents, QUICK.view, BYTES, segments=segments)
    ahead = segments.means[segments.of == 2].max(axis=0)[0]
    eye = [ahead, *segments.means[:, 1:].mean(axis=0)]
    delivery.on_pose(0.0, eye, along_x)  # observed, and predicted from
    found = delivery.urgency(0.0, Pose.from_arrays(eye, along_x)).reshape(3, 5)
    assert found[:, 3:].min() > found[:, :2].max()
    assert (found > 0).all()  # what is behind still comes, last


def test_lapis_sends_whole_levels(measured: Measured) -> None:
    p, contents = played("layers, LapisGS", measured), measured.contents
    for level in range(3):
        assert len(set(p.gaussian_at[contents.first == level].tolist())) == 1
    ends = [p.gaussian_at[contents.first == level][0] for level in range(3)]
    assert ends == sorted(ends)


def test_segments_hold_every_gaussian_once(measured: Measured) -> None:
    contents = measured.contents
    segments = Segments.of_contents(contents, most=100)
    everyone = np.ones(len(contents), bool)
    assert np.array_equal(np.sort(np.concatenate(segments.ids(everyone))), np.arange(len(contents)))
    inside = segments.boxes[segments.of]
    assert ((segments.means >= inside[:, 0]) & (segments.means <= inside[:, 1])).all()
    layers = level_layers(contents, segments, BYTES)
    assert np.array_equal(np.sort(np.concatenate(list(layers.gaussians))), np.arange(len(contents)))
    sorted_out = layers_by_importance(contents, segments, BYTES, 4)
    highest = np.flatnonzero(contents.last == 2)
    assert np.array_equal(np.sort(np.concatenate(list(sorted_out.gaussians))), highest)
    worth = segments.opacities * segments.areas
    count = len(segments)
    for b in range(count):
        some = [worth[sorted_out.gaussians[k * count + b]] for k in range(4)]
        for upper, lower in pairwise(some):
            assert upper.min(initial=np.inf) >= lower.max(initial=0.0)


def test_pieces_refuse_what_they_cannot_be(measured: Measured) -> None:
    pieces = level_files(measured.contents, measured.segments, measured.files.sizes)
    assert pieces.nbytes.sum() == measured.files.sizes.sum()
    with pytest.raises(ValueError, match="in two"):
        Pieces([np.arange(2), np.arange(2)], [np.arange(0)] * 2, np.ones(2, int), np.zeros((2, 2, 3)), np.full(2, -1))
    with pytest.raises(ValueError, match="one for each piece"):
        Pieces([np.arange(2)], [], np.ones(1, int), np.zeros((1, 2, 3)), np.full(1, -1))


def test_files_limit_what_is_in_flight() -> None:
    flow = Files(2)
    flow.on_sent(0.0, [(1, 10), (2, 10)])
    assert flow.ready()
    flow.on_sent(0.0, [(3, 10)])
    assert not flow.ready()
    flow.on_ack(0.1, 1)  # half of the first file
    assert not flow.ready()
    flow.on_ack(0.2, 2)
    assert flow.ready()


def test_a_window_waits_and_always_retries_an_idle_link() -> None:
    flow = Window()
    assert flow.ready()
    flow.on_sent(0.0, [(1, 10_000_000)])
    assert not flow.ready()
    flow.on_ack(5.0, 1)
    assert flow.ready()


def test_a_rival_with_all_in_view_shows_the_scene_itself(scene: StreamedScene, measured: Measured) -> None:
    stage, contents = Stage(scene.contents), scene.contents
    size = len(contents), len(contents.term_records)
    whole = play(WholeFile(contents, 1000), FAST, walk(), size, seconds=QUICK.watched)
    chunks = play(rival("frustum chunks", measured, QUICK.view), FAST, walk(), size, seconds=QUICK.watched)
    for viewing in watch(stage, [whole, chunks], walk(), QUICK):
        assert viewing.psnr[-1] == QUICK.qoe.psnr_scale


def test_terms_of_gaussians(scene: StreamedScene) -> None:
    contents = scene.contents
    ids = np.array([0, 3, 17])
    expected = [k for i in ids for k in range(contents.term_offsets[i], contents.term_offsets[i + 1])]
    assert terms_of(contents, ids).tolist() == expected
