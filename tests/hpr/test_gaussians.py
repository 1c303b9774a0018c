"""The occlusion hull: scenes with a known answer, the laws of light, eyes in odd places, and recall on real scenes."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gsvis.hpr import OcclusionHull, gaussians, visible_gaussians
from gsvis.io import load_scene
from gsvis.raycast import EllipsoidProxies, Tracer, visible_from
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.procedural import OCCLUDER_SCENES, builtin_scene, random_scene


def row(*balls: tuple[float, float, float]) -> Gaussians:
    """Round Gaussians on the x axis, each (x, scale, opacity)."""
    x, scales, opacities = np.array(balls).T
    means = np.stack([x, 0 * x, 0 * x], axis=1)
    n = len(means)
    quats = np.tile([1.0, 0, 0, 0], (n, 1))
    return Gaussians(means, quats, np.repeat(scales[:, None], 3, axis=1), opacities, np.zeros((n, 1, 3)))


@pytest.mark.parametrize("name", sorted(OCCLUDER_SCENES))
def test_scenes_with_a_known_answer(name: str) -> None:
    known = builtin_scene(name)
    seen = np.zeros_like(known.visible)
    for v, eye in enumerate(known.viewpoints):
        seen[v, visible_gaussians(known.gaussians, eye)] = True
    assert seen[known.visible].mean() > 0.998
    assert seen[known.hidden].mean() < 0.05


def test_a_ball_behind_an_opaque_one_is_hidden_and_behind_a_faint_one_is_not() -> None:
    eye, opaque = np.zeros(3), [(3, 0.5, 1.0)] * 3  # three, because one Gaussian is opaque at its very center only
    assert np.array_equal(visible_gaussians(row(*opaque, (8, 0.1, 1.0)), eye), [0, 1, 2])
    assert np.array_equal(visible_gaussians(row((3, 0.5, 0.5), (8, 0.1, 1.0)), eye), [0, 1])
    assert np.array_equal(visible_gaussians(row(*opaque, (-8, 0.1, 1.0)), eye), [0, 1, 2, 3])


def test_many_faint_ones_hide_together() -> None:
    faint = [(3 + 0.1 * i, 0.5, 0.6) for i in range(12)]
    seen = visible_gaussians(row(*faint, (8, 0.1, 1.0)), np.zeros(3))
    assert 0 in seen
    assert 12 not in seen


def test_orientation_counts() -> None:
    discs = row(*[(3, 0.5, 1.0)] * 3, (8, 0.1, 1.0))
    across = replaced(discs, scales=[[1e-3, 0.5, 0.5]] * 3 + [[0.1] * 3])
    along = replaced(discs, scales=[[0.5, 1e-3, 1e-3]] * 3 + [[0.1] * 3])
    assert np.array_equal(visible_gaussians(across, np.zeros(3)), [0, 1, 2])
    assert np.array_equal(visible_gaussians(along, np.zeros(3)), [0, 1, 2, 3])


def replaced(g: Gaussians, **arrays: object) -> Gaussians:
    names = ("means", "quats", "scales", "opacities", "sh0", "shN")
    return Gaussians(**{name: arrays.get(name, getattr(g, name)) for name in names})


def test_what_is_too_faint_to_be_seen_is_not() -> None:
    g = row((3, 0.5, 0.003), (8, 0.1, 1.0))
    assert np.array_equal(visible_gaussians(g, np.zeros(3)), [1])
    assert OcclusionHull.from_scene(g, np.zeros(3)).nearness()[0] == np.inf


@given(seed=st.integers(0, 10**6), share=st.floats(0.0, 1.0))
def test_more_opacity_never_shows_more_of_the_others(seed: int, share: float) -> None:
    rng = np.random.default_rng(seed)
    g = random_scene(rng, 300)
    front = rng.random(len(g)) < 0.3
    opacities = g.opacities.astype(np.float64)
    opacities[rng.random(len(g)) < 0.3] *= 0.004  # too faint to be seen at first
    g = replaced(g, opacities=opacities)
    opacities = np.where(front, opacities + share * (1.0 - opacities), opacities)
    eye = rng.normal(scale=3.0, size=3)
    before = OcclusionHull.from_scene(g, eye, size=16)
    after = OcclusionHull.from_scene(replaced(g, opacities=opacities), eye, size=16)
    assert (after.nearness()[~front] >= before.nearness()[~front] * (1 - 1e-5)).all()


@pytest.mark.parametrize("kind", ["blob", "discs", "needles", "nested", "coincident"])
def test_order_changes_nothing_and_a_subset_asks_the_same_question(kind: str) -> None:
    rng = np.random.default_rng(3)
    g = random_scene(rng, 2000, kind=kind)
    eye = np.array([4.0, 0.5, 0.2])
    want = visible_gaussians(g, eye, size=32)
    order = rng.permutation(len(g))
    turned = np.sort(order[visible_gaussians(g[order], eye, size=32)])
    assert len(np.setxor1d(turned, want)) <= 0.002 * len(g)  # sums in another order, at the edge of a bin
    ids = np.sort(rng.choice(len(g), 200, replace=False))
    assert np.array_equal(visible_gaussians(g, eye, ids=ids[::-1], size=32), np.intersect1d(want, ids))
    assert len(visible_gaussians(g, eye, ids=[], size=32)) == 0


def test_another_unit_of_length_changes_nothing() -> None:
    g = random_scene(np.random.default_rng(0), 3000)
    eye = np.array([4.0, 0.5, 0.2])
    near = OcclusionHull.from_scene(g, eye, size=32).nearness()
    far = OcclusionHull.from_scene(g.transform(np.eye(3), scale=1e3), 1e3 * eye, size=32).nearness()
    assert np.mean((near <= 1) != (far <= 1)) < 0.002


def test_ends_of_light_that_come_nearer_never_show_more() -> None:
    rng = np.random.default_rng(5)
    g, size = random_scene(rng, 500), 16
    ends = np.where(rng.random((6, size, size)) < 0.05, rng.uniform(1.0, 20.0, (6, size, size)), np.inf)
    nearer = np.where(np.isfinite(ends), np.minimum(ends, 3.0), ends)
    before, after = (OcclusionHull.from_depths(g, np.zeros(3), depths).nearness() for depths in (ends, nearer))
    assert (after >= before * (1 - 1e-5)).all()


def test_gaussians_around_the_eye_alone_have_no_far_and_are_seen() -> None:
    g = row((0.0, 0.5, 1.0), (0.0, 0.2, 1.0))
    ends = np.full((6, 8, 8), 3.0)
    assert np.array_equal(OcclusionHull.from_depths(g, np.zeros(3), ends).depths, ends.reshape(-1))
    assert np.array_equal(visible_gaussians(g, np.zeros(3)), [0, 1])


def test_less_spent_and_more_margin_show_more() -> None:
    g = random_scene(np.random.default_rng(0), 20_000)
    eye = np.array([1.5, 0.5, 0.2])
    few = set(visible_gaussians(g, eye, spent=0.1, margin=0.05))
    assert few <= set(visible_gaussians(g, eye, spent=0.001, margin=0.05))
    assert few <= set(visible_gaussians(g, eye, spent=0.1, margin=0.3))
    assert len(few) < len(g) / 2


def test_an_eye_inside_an_opaque_gaussian_sees_what_is_around_it_only() -> None:
    fog = row((0.1, 0.5, 1.0), (8, 0.1, 1.0), (-8, 0.1, 1.0), (0.0, 0.4, 1.0))
    assert np.array_equal(visible_gaussians(fog, np.zeros(3)), [0, 3])
    veil = row((0.1, 0.5, 0.3), (8, 0.1, 1.0), (-8, 0.1, 1.0))
    assert np.array_equal(visible_gaussians(veil, np.zeros(3)), [0, 1, 2])
    centered = row((0.0, 0.5, 1.0), (8, 0.1, 1.0))
    assert np.array_equal(visible_gaussians(centered, np.zeros(3)), [0])


def test_scenes_of_nothing_of_one_and_of_faint_ones() -> None:
    assert len(visible_gaussians(Gaussians.empty(), np.zeros(3))) == 0
    assert np.array_equal(visible_gaussians(row((3, 0.1, 0.9)), np.zeros(3)), [0])
    assert np.isinf(OcclusionHull.from_scene(row((3, 0.1, 0.5)), np.zeros(3)).depths).all()
    assert len(visible_gaussians(row((3, 0.1, 0.001)), np.zeros(3))) == 0


def test_outliers_change_little() -> None:
    known = builtin_scene("two_rooms")
    g, eye = known.gaussians, known.viewpoints[0]
    want = visible_gaussians(g, eye)
    far = replaced(g[:3], means=[[1e5, 0, 0], [0, -2e5, 1e5], [1e4, 1e4, 1e4]])
    seen = visible_gaussians(Gaussians.concatenate([g, far]), eye)
    assert len(np.setxor1d(seen[seen < len(g)], want)) < 0.01 * len(want)


def test_without_a_hull_each_cell_speaks_for_itself(monkeypatch: pytest.MonkeyPatch) -> None:
    g, eye = builtin_scene("nested_shells").gaussians, np.zeros(3)
    with_hull = OcclusionHull.from_scene(g, eye)
    monkeypatch.setattr(gaussians.Hull, "around", lambda *_, **__: (None, None))
    alone = OcclusionHull.from_scene(g, eye)
    assert (with_hull.depths <= alone.depths * (1 + 1e-6)).all()
    assert np.isfinite(alone.depths).mean() > 0.9
    assert (with_hull.nearness() >= alone.nearness() * (1 - 1e-6)).all()


@pytest.mark.realdata
@pytest.mark.parametrize(("name", "lod", "recall"), [("showroom", 3, 0.95), ("nika_sh3", 2, 0.99)])
def test_little_weight_is_lost_on_real_scenes(realdata, real_space, name: str, lod: int, recall: float) -> None:
    g = load_scene(realdata / "scenes" / name / "lod-meta.json", lod=lod)
    eyes = real_space(g).sample_viewpoints(2, np.random.default_rng(7))
    weights = visible_from(Tracer(EllipsoidProxies.from_scene(g)), eyes, size=64)
    for eye, weight in zip(eyes, weights, strict=True):
        seen = visible_gaussians(g, eye)
        assert weight[seen].sum() > recall * weight.sum()


@pytest.mark.parametrize(
    ("words", "options"),
    [
        (r"viewpoint: expected shape \(3,\)", {"viewpoint": np.zeros(2)}),
        ("viewpoint: expected finite values", {"viewpoint": [np.nan, 0, 0]}),
        ("size: expected 4 to 256 cells, got 512", {"size": 512}),
        ("size: expected an integer", {"size": 1.5}),
        ("spent: expected a transmittance", {"spent": 1.0}),
        ("margin: expected a share", {"margin": 0.0}),
        ("ids: expected values in", {"ids": [7]}),
        ("ids: expected integers", {"ids": [0.5]}),
    ],
)
def test_what_makes_no_sense_is_refused(words: str, options: dict) -> None:
    with pytest.raises(ValueError, match=words):
        visible_gaussians(row((3, 0.1, 0.5)), **{"viewpoint": np.zeros(3), **options})
