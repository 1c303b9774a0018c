"""The hierarchical z-buffer: equal to every Gaussian on every pixel, conservative, and blind to order."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numba import get_num_threads, set_num_threads

from gsvis.hpr import Search, Seen, Splats, hybrid, look_around, squares_around
from gsvis.hpr.reference import look_around_reference
from gsvis.hpr.zbuffer import ZBuffer
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.procedural import OCCLUDER_SCENES, builtin_scene, random_scene

TAU = 1.0 / 255.0


def around(count: int, seed: int, *, near: float = 0.5, opaque: bool = False) -> Gaussians:
    """Gaussians on all sides of the origin, at distances of 0.5 to 4."""
    rng = np.random.default_rng(seed)
    directions = rng.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    means = directions * rng.uniform(near, 4.0, (count, 1))
    quats = rng.normal(size=(count, 4))
    scales = np.exp(rng.uniform(np.log(0.02), np.log(0.5), (count, 3)))
    opacities = np.full(count, 0.99) if opaque else rng.uniform(0.01, 1.0, count)
    return Gaussians(
        means, quats / np.linalg.norm(quats, axis=1, keepdims=True), scales, opacities, np.zeros((count, 1, 3))
    )


def dense(seen: Seen, count: int) -> tuple[np.ndarray, np.ndarray]:
    weights, light = np.zeros(count), np.zeros(count)
    weights[seen.ids], light[seen.ids] = seen.weights, seen.light
    return weights, light


@pytest.mark.parametrize(("seed", "size"), [*((seed, size) for seed in range(3) for size in (5, 19)), (3, 70)])
def test_it_finds_what_splatting_everything_finds(seed: int, size: int) -> None:
    g = around(150, seed)
    seen = look_around(Splats.from_gaussians(g), np.zeros(3), size=size, spent=1e-3)
    weights, light, depths = look_around_reference(g, np.zeros(3), size, 1e-3)
    found_weights, found_light = dense(seen, len(g))
    lit = light >= 1e-3
    np.testing.assert_allclose(found_weights[lit], weights[lit], atol=2e-4)
    np.testing.assert_allclose(found_light[lit], light[lit], atol=2e-4)
    assert (weights[~lit] < 1e-3).all()
    assert not np.isin(np.flatnonzero(light < 0.9e-3), seen.ids).any()
    same = np.isclose(seen.zbuffer.depths, depths, rtol=1e-5)
    assert same.mean() > 0.999  # a pixel whose light ends within rounding of the bound may end one Gaussian later


@pytest.mark.parametrize("size", [12, 40, 120])
def test_the_light_between_specks_does_not_depend_on_the_size_of_pixels(size: int) -> None:
    rng = np.random.default_rng(0)
    count = 10_000
    radius = 0.024  # 0.07 to 0.7 pixels
    means = np.column_stack([np.full(count, 2.0), rng.uniform(-3.0, 3.0, (count, 2))])
    quats = np.tile([1.0, 0.0, 0.0, 0.0], (count, 1))
    g = Gaussians(means, quats, np.full((count, 3), radius), np.full(count, 0.9), np.zeros((count, 1, 3)))
    seen = look_around(Splats.from_gaussians(g), np.zeros(3), size=size)
    some = slice(3 * size // 8, -(3 * size // 8))
    middle = seen.zbuffer.light[0, some, some]
    inside = np.count_nonzero(np.abs(means[:, 1:]).max(axis=1) < 0.5)  # of a square of 1 x 1
    layers = inside * 0.9 * 2.0 * np.pi * radius**2  # opacity times area
    assert middle.mean() == pytest.approx(np.exp(-layers), rel=0.08)


@pytest.mark.parametrize("name", sorted(OCCLUDER_SCENES))
def test_nothing_visible_is_missing_and_nothing_behind_a_solid_wall_is_kept(name: str) -> None:
    scene = builtin_scene(name)
    splats = Splats.from_gaussians(scene.gaussians)
    # Seams of walls seen edge on: splats are ordered by their centers there, rays by where they are densest.
    allowed = 1e-3 if name == "two_rooms" else 0.0
    for v, viewpoint in enumerate(scene.viewpoints):
        seen = hybrid(scene.gaussians, splats, viewpoint, size=384)
        assert not scene.hidden[v][seen.ids].any()
        missing = ~np.isin(np.flatnonzero(scene.visible[v]), seen.ids)
        assert missing.mean() <= allowed


def test_hides_is_conservative_and_not_idle() -> None:
    g = Gaussians.concatenate([around(3000, 1, opaque=True), around(2000, 2, near=3.9)])
    splats = Splats.from_gaussians(g)
    seen = look_around(splats, np.zeros(3), size=32)
    hidden = splats.ids[seen.zbuffer.hides(splats)]
    assert len(hidden) > 500
    assert not np.isin(hidden, seen.ids[seen.weights >= TAU]).any()


def test_an_open_sky_hides_nothing() -> None:
    splats = Splats.from_gaussians(around(20, 3))
    depths = np.full((6, 8, 8), np.inf, np.float32)
    open_sky = ZBuffer(np.zeros(3), TAU, depths, np.ones((6, 8, 8), np.float32))
    assert not open_sky.hides(splats).any()


def test_a_ball_that_holds_the_eye_is_never_hidden() -> None:
    g = Gaussians([[0.1, 0, 0]], [[1, 0, 0, 0]], [[1, 1, 1]], [0.9], np.zeros((1, 1, 3)))
    near = ZBuffer(np.zeros(3), TAU, np.full((6, 8, 8), 1e-3, np.float32), np.zeros((6, 8, 8), np.float32))
    assert not near.hides(Splats.from_gaussians(g)).any()


def test_the_pyramid_bounds_what_lies_under_it() -> None:
    g = around(500, 4, opaque=True)
    buffer = look_around(Splats.from_gaussians(g), np.zeros(3), size=24).zbuffer
    most, least = buffer.pyramid(), buffer.pyramid(largest=False)
    assert most[-1].shape == (6, 1, 1)
    np.testing.assert_array_equal(most[-1][:, 0, 0], buffer.depths.reshape(6, -1).max(axis=1))
    np.testing.assert_array_equal(least[-1][:, 0, 0], buffer.depths.reshape(6, -1).min(axis=1))
    for k in range(1, len(most)):
        under = buffer.depths[:, : 2**k, : 2**k].reshape(6, -1)
        np.testing.assert_array_equal(most[k][:, 0, 0], under.max(axis=1))


@pytest.mark.parametrize(("size", "fold"), [(24, 2), (70, 8), (129, 64)])
def test_blocks_of_depths_are_a_level_of_the_pyramid(size: int, fold: int) -> None:
    splats = Splats.from_gaussians(around(500, 4, opaque=True))
    whole, folded = (look_around(splats, np.zeros(3), size=size, fold=each) for each in (1, fold))
    level = whole.zbuffer.pyramid()[fold.bit_length() - 1]
    np.testing.assert_array_equal(folded.zbuffer.depths, level)
    np.testing.assert_array_equal(folded.weights, whole.weights)


def test_blocks_of_depths_have_sides_of_powers_of_two() -> None:
    with pytest.raises(ValueError, match=r"^fold: expected a power of two from 1 to 64, got 3"):
        look_around(Splats.from_gaussians(around(5, 0)), np.zeros(3), size=16, fold=3)


@pytest.mark.parametrize("look", ["zbuffer", "hybrid"])
def test_the_order_of_the_scene_changes_nothing(look: str) -> None:
    g = Gaussians.concatenate([around(400, 5), around(400, 5)[np.arange(50)]])  # with equal distances
    rng = np.random.default_rng(0)
    order = rng.permutation(len(g))
    results = []
    for scene in (g, g[order]):
        splats = Splats.from_gaussians(scene)
        eye = np.array([0.2, -0.1, 0.3])
        results.append(look_around(splats, eye, size=32) if look == "zbuffer" else hybrid(scene, splats, eye, size=32))
    first, second = dense(results[0], len(g))[0], dense(results[1], len(g))[0]
    # Twins in all but their index share what they get, in either order.
    np.testing.assert_array_equal(np.sort(first), np.sort(second))
    np.testing.assert_allclose(results[0].zbuffer.light, results[1].zbuffer.light, atol=0)


def test_the_number_of_threads_changes_nothing() -> None:
    splats = Splats.from_gaussians(around(4000, 9))
    before, results = get_num_threads(), []
    try:
        for threads in (1, before):
            set_num_threads(threads)
            results.append(look_around(splats, np.array([0.1, 0.2, -0.3]), size=150))
    finally:
        set_num_threads(before)
    one, many = ([r.ids, r.weights, r.light, r.zbuffer.depths, r.zbuffer.light] for r in results)
    assert [a.tobytes() for a in one] == [a.tobytes() for a in many]


def test_rooms_behind_a_wall_change_nothing() -> None:
    front = around(3000, 1, opaque=True)
    rng = np.random.default_rng(2)
    toward = rng.normal(size=(3000, 3))
    means = toward / np.linalg.norm(toward, axis=1, keepdims=True) * rng.uniform(8.0, 40.0, (3000, 1))
    behind = Gaussians(means, front.quats, 0.1 * front.scales, front.opacities, front.sh0)
    alone = look_around(Splats.from_gaussians(front), np.zeros(3), size=100)
    assert (alone.zbuffer.light < TAU).all()
    both = look_around(Splats.from_gaussians(Gaussians.concatenate([front, behind])), np.zeros(3), size=100)
    np.testing.assert_array_equal(both.ids, alone.ids)
    np.testing.assert_array_equal(both.weights, alone.weights)
    np.testing.assert_array_equal(both.zbuffer.light, alone.zbuffer.light)


@pytest.mark.parametrize("size", [40, 100])
def test_without_a_buffer_the_same_is_found(size: int) -> None:
    splats = Splats.from_gaussians(around(900, 4))
    for eye in (np.zeros(3), np.array([30.0, 2.0, 1.0])):  # from afar most squares are empty
        with_one, without = (look_around(splats, eye, size=size, buffer=buffer) for buffer in (True, False))
        np.testing.assert_array_equal(with_one.ids, without.ids)
        np.testing.assert_array_equal(with_one.weights, without.weights)
        np.testing.assert_array_equal(with_one.light, without.light)
        assert without.zbuffer.size == 0


@pytest.mark.parametrize("size", [40, 200])
def test_in_some_squares_their_gaussians_are_seen_as_everywhere(size: int) -> None:
    g = around(900, 4)
    splats = Splats.from_gaussians(g)
    eye = np.array([0.2, -0.1, 0.3])
    some = np.arange(0, 900, 150)
    squares = squares_around(splats, eye, some, size)
    everywhere = look_around(splats, eye, size=size, buffer=False)
    there = look_around(splats, eye, size=size, buffer=False, search=Search(squares=squares))
    for ours, theirs in zip(dense(there, 900), dense(everywhere, 900), strict=True):
        np.testing.assert_array_equal(ours[some], theirs[some])
        assert (ours <= theirs).all()
    if size == 200:
        assert 0 < squares.sum() < squares.size
        assert len(there.ids) < len(everywhere.ids)


def test_no_square_holds_what_cannot_be_seen_or_nothing() -> None:
    g = Gaussians([[1, 0, 0], [0, 2, 0]], [[1, 0, 0, 0]] * 2, [[0.01] * 3] * 2, [0.003, 0.9], np.zeros((2, 1, 3)))
    splats = Splats.from_gaussians(g)
    assert not squares_around(splats, np.zeros(3), [], 100).any()
    assert not squares_around(splats, np.zeros(3), [0], 100).any()
    found = squares_around(splats, np.zeros(3), [0, 1], 192)
    assert np.argwhere(found).tolist() == [[2, 1, 1]]  # the middle of the face along +y


def sheets_of_specks(count: int) -> Gaussians:
    """Two sheets of specks at distances 2 and 2.5 on the +x side, and behind them a few larger Gaussians."""
    rng = np.random.default_rng(0)
    means = np.column_stack([rng.choice([2.0, 2.5], count), rng.uniform(-2.0, 2.0, (count, 2))])
    beyond = np.column_stack([np.full(9, 3.5), rng.uniform(-1.5, 1.5, (9, 2))])
    means = np.concatenate([means, beyond])
    scales = np.concatenate([np.full((count, 3), 0.004), np.full((9, 3), 0.1)])
    quats = np.tile([1.0, 0.0, 0.0, 0.0], (len(means), 1))
    return Gaussians(means, quats, scales, np.full(len(means), 0.9), np.zeros((len(means), 1, 3)))


def test_thinned_specks_take_the_light_that_all_of_them_take() -> None:
    count = 60_000
    g = sheets_of_specks(count)
    splats = Splats.from_gaussians(g)
    known = np.arange(len(g)) < count
    looks = [
        look_around(splats, np.zeros(3), size=64, search=Search(known=mask, least=0.3))
        for mask in (known, np.zeros(len(g), bool), None)
    ]
    looks.append(look_around(splats, np.zeros(3), size=64))
    thinned, *_, whole = (dense(seen, len(g)) for seen in looks)
    behind = slice(count, None)
    assert 0.2 < whole[1][behind].mean() < 0.9  # light that passes the sheets
    np.testing.assert_allclose(thinned[0][behind], whole[0][behind], rtol=0.25)  # the largest of a few pixels: noisy
    left, right = (seen.zbuffer.light[0, 20:-20, 20:-20].mean() for seen in (looks[0], looks[-1]))
    assert left == pytest.approx(right, rel=0.03)
    assert len(looks[1].ids) < 0.2 * len(looks[-1].ids)
    # a speck of this size has a weight below 0.3, so it is thinned whether it is known or not
    np.testing.assert_array_equal(looks[1].ids, looks[2].ids)
    assert looks[0].ids.tolist() == list(range(count, count + 9))  # what is known is not found
    for mine, plain in zip(thinned, dense(looks[1], len(g)), strict=True):
        np.testing.assert_array_equal(mine[behind], plain[behind])


def test_what_is_large_enough_to_be_found_is_never_thinned() -> None:
    count = 20_000
    g = sheets_of_specks(count)
    splats = Splats.from_gaussians(g)
    some = np.random.default_rng(1).random(len(g)) < 0.5
    whole = dense(look_around(splats, np.zeros(3), size=64), len(g))[0]
    least = 0.5 * float(whole[:count].max())
    seen = look_around(splats, np.zeros(3), size=64, search=Search(known=some, least=least))
    found = dense(seen, len(g))[0]
    sought = ~some & (whole >= least)
    assert sought[:count].sum() > 1000
    assert (found[sought] > 0.0).all()
    np.testing.assert_allclose(found[sought], whole[sought], rtol=0.3)  # each where its own light is


def test_fainter_gaussians_come_beside_those_that_are_found_without_them() -> None:
    g = random_scene(np.random.default_rng(3), 3000)
    splats, eye = Splats.from_gaussians(g), g.means.mean(axis=0)
    plain, more = hybrid(g, splats, eye, size=64), hybrid(g, splats, eye, size=64, faint=0.25 * TAU)
    assert len(more.ids) > len(plain.ids)
    visible = more.weights >= np.float32(TAU)
    np.testing.assert_array_equal(more.ids[visible], plain.ids)
    np.testing.assert_array_equal(more.weights[visible], plain.weights)
    assert (more.weights >= np.float32(0.25 * TAU)).all()
    with pytest.raises(ValueError, match="faint"):
        hybrid(g, splats, eye, size=64, faint=2.0 * TAU)


def test_what_weighs_enough_is_found_alike_whatever_else_is_known() -> None:
    g = random_scene(np.random.default_rng(5), 3000)
    splats, eye = Splats.from_gaussians(g), g.means.mean(axis=0)
    tau = 0.05
    known = np.random.default_rng(6).random(len(g)) < 0.5
    plain = hybrid(g, splats, eye, size=128, tau=tau, margin=None)
    mine = hybrid(g, splats, eye, size=128, tau=tau, margin=None, search=Search(known=known))
    assert not known[mine.ids].any()
    heavy = ~known[plain.ids] & (plain.weights > np.float32(tau))  # others are lifted to tau where light is doubtful
    assert np.count_nonzero(heavy) > 15
    found = dense(mine, len(g))[0]
    np.testing.assert_array_equal(found[plain.ids[heavy]], plain.weights[heavy])


def test_more_in_front_never_shows_more_behind() -> None:
    behind = around(800, 6, near=2.0)
    for opacity in (0.1, 0.5, 0.9):
        front = around(200, 7, near=0.5)
        front = Gaussians(front.means / 4.0, front.quats, front.scales / 4.0, np.full(200, opacity), front.sh0)
        more = Gaussians(front.means, front.quats, front.scales, np.full(200, min(1.0, opacity * 1.1)), front.sh0)
        seen = [
            dense(look_around(Splats.from_gaussians(Gaussians.concatenate([f, behind])), np.zeros(3), size=32), 1000)[
                0
            ][200:]
            for f in (front, more)
        ]
        assert (seen[1] <= seen[0] + 1e-6).all()


def test_the_hybrid_holds_what_the_z_buffer_sees() -> None:
    g = random_scene(np.random.default_rng(3), 3000)
    splats = Splats.from_gaussians(g)
    alone, both = look_around(splats, g.means.mean(axis=0), size=64), hybrid(g, splats, g.means.mean(axis=0), size=64)
    assert np.isin(alone.ids[alone.weights >= np.float32(TAU)], both.ids).all()
    assert (both.weights >= np.float32(TAU)).all()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"size": 3}, "size: expected 4 to 4096"),
        ({"spent": 0.0}, "spent: expected a transmittance"),
        ({"viewpoint": [np.nan, 0, 0]}, "viewpoint: expected finite"),
        ({"viewpoint": [0, 0]}, "viewpoint: expected shape"),
        ({"search": Search(squares=np.zeros((6, 4, 4), bool))}, "buffer: expected False with squares"),
        ({"search": Search(squares=np.ones((6, 2, 2), bool))}, r"squares: expected shape \(6, 4, 4\)"),
        ({"search": Search(known=np.ones(6, bool))}, r"known: expected shape \(5,\)"),
    ],
)
def test_bad_arguments(change: dict[str, Any], message: str) -> None:
    arguments: dict[str, Any] = {"viewpoint": np.zeros(3), **change}
    with pytest.raises(ValueError, match=message):
        look_around(Splats.from_gaussians(around(5, 0)), arguments.pop("viewpoint"), **arguments)


def test_an_empty_scene_and_one_too_faint_show_nothing() -> None:
    faint = Gaussians([[1, 0, 0]], [[1, 0, 0, 0]], [[1, 1, 1]], [0.003], np.zeros((1, 1, 3)))
    for g in (Gaussians.empty(), faint):
        seen = look_around(Splats.from_gaussians(g), np.zeros(3), size=8)
        assert len(seen.ids) == 0
        assert np.isinf(seen.zbuffer.depths).all()
        assert len(hybrid(g, Splats.from_gaussians(g), np.zeros(3), size=8).ids) == 0


def test_splats_of_another_scene_are_refused() -> None:
    with pytest.raises(ValueError, match="splats: expected 5 Gaussians, those of this scene"):
        hybrid(around(5, 0), Splats.from_gaussians(around(6, 0)), np.zeros(3))


def test_extreme_shapes_do_no_harm() -> None:
    rng = np.random.default_rng(8)
    scales = 10.0 ** rng.uniform(-12, 8, (300, 3))
    means = rng.normal(size=(300, 3)) * 10.0 ** rng.uniform(-6, 6, (300, 1))
    g = Gaussians(means, np.tile([1.0, 0, 0, 0], (300, 1)), scales, rng.random(300), np.zeros((300, 1, 3)))
    seen = look_around(Splats.from_gaussians(g), np.zeros(3), size=16)
    assert np.isfinite(seen.weights).all()
    assert ((seen.zbuffer.light >= 0) & (seen.zbuffer.light <= 1)).all()
    seen.zbuffer.hides(Splats.from_gaussians(g))


@pytest.mark.realdata
def test_it_agrees_with_the_rasterizer_on_a_real_scene(realdata) -> None:  # type: ignore[no-untyped-def]
    from gsvis.io import load_scene
    from gsvis.render import view_weights

    g = load_scene(realdata / "scenes/nika_sh3/lod-meta.json", lod=3)
    eye = np.median(g.means, axis=0).astype(np.float64)
    seen = look_around(Splats.from_gaussians(g), eye, size=128, spent=TAU)
    weights = dense(seen, len(g))[0]
    largest = view_weights(g, Cameras.cubemap(eye[None], 128)).largest.max(axis=0)
    visible = largest >= TAU
    assert largest[visible & (weights >= TAU)].sum() >= 0.985 * largest[visible].sum()
