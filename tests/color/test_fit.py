"""Laws of the fit: what a base and its terms must do whatever the scene, and what they must do on known functions."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gsvis.color import VARIANTS, FitConfig, SrbfFit, evaluate_along, fit_srbf, reference, srbf, unit_vectors
from gsvis.color._kernels.fit import fit_lobes
from gsvis.color._kernels.refine import add_lobe, find_products, refine, work
from gsvis.color._pursuit import Pursuit
from gsvis.color._work import count_progress, foresee_work
from gsvis.color.fit import sample_colors
from gsvis.scene.gaussians import Gaussians
from gsvis.scene.icosphere import face_directions, face_shares, icosphere

POINTS = -face_directions(4).reshape(-1, 3)
SHARES = face_shares(4).reshape(-1) * 320


def scene(count: int, seed: int = 0, spread: float = 0.15, degree: int = 3) -> Gaussians:
    """Gaussians whose colors change with direction, mostly within (0, 1)."""
    rng = np.random.default_rng(seed)
    return Gaussians(
        rng.normal(size=(count, 3)),
        rng.normal(size=(count, 4)),
        np.full((count, 3), 0.1),
        np.full(count, 0.5),
        rng.uniform(-0.7, 0.9, (count, 1, 3)),
        rng.normal(scale=spread, size=(count, (degree + 1) ** 2 - 1, 3)),
    )


def caps(count: int, seed: int = 0) -> np.ndarray:
    """(N, 80) bool, faces within a random cap of 40 to 100 degrees."""
    rng = np.random.default_rng(seed)
    centers = rng.normal(size=(count, 3))
    centers /= np.linalg.norm(centers, axis=1, keepdims=True)
    cosines = centers @ face_directions(1)[:, 0].T
    return cosines > np.cos(np.radians(rng.uniform(40, 100, count)))[:, None]


def errors_along(g: Gaussians, faces: np.ndarray, fit: SrbfFit, most: int) -> np.ndarray:
    """(N, most + 1) weighted mean squared RGB error with the first 0, 1, ... terms."""
    weights = np.repeat(faces, 4, axis=1) * SHARES
    weights /= weights.sum(axis=1, keepdims=True)
    truth = sample_colors(g).transpose(0, 2, 1)
    rows = []
    for count in range(most + 1):
        shown = evaluate_along(fit.colors.first(count), POINTS)
        rows.append((np.square(shown - truth).sum(axis=2) * weights).sum(axis=1))
    return np.stack(rows, axis=1)


@pytest.mark.parametrize("refined", [True, False])
@pytest.mark.parametrize("name", list(VARIANTS))
def test_error_never_rises_along_the_order_of_terms(name: str, refined: bool) -> None:
    g, faces = scene(60, spread=0.06), caps(60)
    fit = fit_srbf(g, faces, FitConfig(variant=name, max_terms=4, mean_terms=None, refine=refined))
    along = errors_along(g, faces, fit, int(fit.colors.counts.max()))
    assert fit.colors.num_terms > 60
    assert np.all(np.diff(along, axis=1) <= 2e-6 * along[:, :1] + 1e-9)
    np.testing.assert_allclose(along[:, 0], fit.base_errors, rtol=2e-3, atol=1e-8)
    np.testing.assert_allclose(along[:, -1], fit.errors, rtol=2e-2, atol=1e-7)


@pytest.mark.parametrize("name", list(VARIANTS))
def test_terms_help_and_refinement_helps_more(name: str) -> None:
    g, faces = scene(80), caps(80)
    plain, moved = (
        fit_srbf(g, faces, FitConfig(variant=name, max_terms=3, mean_terms=None, refine=refined))
        for refined in (False, True)
    )
    assert plain.errors.mean() < 0.95 * plain.base_errors.mean()  # random channels: a fixed hue says little of them
    assert moved.errors.mean() < plain.errors.mean()


def test_ours_beat_the_papers_at_the_same_number_of_terms() -> None:
    g, faces = scene(200), caps(200)
    errors = {
        name: fit_srbf(g, faces, FitConfig(variant=name, max_terms=8, mean_terms=3.0)).errors.mean()
        for name in VARIANTS
    }
    assert errors["rgb"] < errors["hsl"]


def test_what_is_not_seen_has_no_say() -> None:
    """Two scenes that agree where they are seen (the mirror image of the other half) get the same colors."""
    g = scene(30, degree=1)
    upper = face_directions(1)[:, 0, 2] > 0.1
    seen = np.broadcast_to(upper, (30, 80))
    fit = fit_srbf(g, seen, FitConfig(mean_terms=None, max_terms=3))
    weights = np.where(seen, 7.0, 0.0)  # the scale of the weights does not matter
    again = fit_srbf(g, weights, FitConfig(mean_terms=None, max_terms=3))
    np.testing.assert_allclose(fit.colors.base, again.colors.base, atol=1e-6)
    np.testing.assert_allclose(fit.errors, again.errors, rtol=0.05, atol=1e-6)
    everywhere = fit_srbf(g, None, FitConfig(mean_terms=None, max_terms=3))
    assert fit.errors.mean() < everywhere.errors.mean()  # half the sphere is the easier half


def test_sets_of_bits_and_of_booleans_mean_the_same() -> None:
    g, faces = scene(20), caps(20)
    config = FitConfig(mean_terms=None, max_terms=2)
    left = fit_srbf(g, faces, config)
    right = fit_srbf(g, np.packbits(faces, axis=1, bitorder="little"), config)
    np.testing.assert_array_equal(left.colors.intensities, right.colors.intensities)


def test_weights_may_come_for_some_gaussians_at_a_time(monkeypatch: pytest.MonkeyPatch) -> None:
    g, faces = scene(90), caps(90)
    faces[7] = False
    config = FitConfig(mean_terms=2.0, max_terms=3)
    importance = np.random.default_rng(1).uniform(size=90)
    whole = fit_srbf(g, faces, config, importance=importance)
    asked: list[np.ndarray] = []
    monkeypatch.setattr("gsvis.color.fit._CHUNK", 32)

    def weigh(ids: np.ndarray) -> np.ndarray:
        asked.append(ids)
        return faces[ids].astype(np.float32)

    parts = fit_srbf(g, weigh, config, importance=importance)
    assert max(map(len, asked)) <= 32
    assert (parts.price, parts.unseen) == (whole.price, 1)
    assert np.array_equal(parts.errors, whole.errors)
    assert np.array_equal(parts.colors.intensities, whole.colors.intensities)


def test_a_gaussian_is_fitted_alike_in_any_company() -> None:
    g, faces = scene(2100), caps(2100)  # more than one chunk
    config = FitConfig(mean_terms=None, max_terms=2)
    order = np.random.default_rng(1).permutation(2100)
    left = fit_srbf(g, faces, config).colors[order]
    right = fit_srbf(g[order], faces[order], config).colors
    for name in ("base", "offsets", "functions", "centers", "decays", "intensities"):
        np.testing.assert_array_equal(getattr(left, name), getattr(right, name))


@pytest.mark.parametrize("emphasis", [0.0, 0.01])
def test_one_lobe_more_never_makes_a_fit_worse(emphasis: float) -> None:
    """Also where no joint fit falls along its prefixes; such a fit once lost all its lobes."""
    g = scene(40, spread=0.4)
    pursuit = Pursuit(FitConfig(max_terms=16, mean_terms=None, emphasis=emphasis))
    weights = np.ones((40, 320), np.float32)
    curves = pursuit.fit(sample_colors(g), weights, np.ones(40), 0.0, np.zeros(40, bool)).lobes[0].curves
    assert (np.diff(curves, axis=1) <= 1e-6 * curves[:, :1]).all()
    assert (curves[:, 16] < 0.2 * curves[:, 0]).all()


def test_the_price_is_that_of_whole_curves() -> None:
    """Long curves are fitted only where they can be worth the price that few terms have."""
    g, faces = scene(600), caps(600).astype(np.float32)
    importance = np.random.default_rng(0).lognormal(sigma=2.0, size=600)
    config = FitConfig(mean_terms=2.0, max_terms=12, width_price=0.0)
    pursuit = Pursuit(config)
    found = fit_srbf(g, faces, config, importance=importance)
    weights = np.repeat(faces, 4, axis=1) * SHARES.astype(np.float32)
    curves = pursuit.fit(sample_colors(g), weights, importance, 0.0, np.zeros(600, bool)).lobes[0].curves
    costs = importance[:, None] * curves + found.price * np.arange(13)
    assert abs(costs.argmin(axis=1).mean() - 0.98 * 2.0) < 0.01


@pytest.mark.parametrize("wanted", [0.5, 2.0])
def test_mean_terms_are_met(wanted: float) -> None:
    g, faces = scene(600), caps(600)
    importance = np.random.default_rng(0).lognormal(sigma=2.0, size=600)
    fit = fit_srbf(g, faces, FitConfig(mean_terms=wanted, max_terms=6), importance=importance)
    assert abs(fit.colors.counts.mean() - wanted) < 0.05
    heavy = importance > np.quantile(importance, 0.9)
    assert fit.colors.counts[heavy].mean() > fit.colors.counts[~heavy].mean()


def test_progress_counts_work_where_terms_lie_at_the_beginning(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gsvis.color.fit._CHUNK", 64)
    importance = np.repeat([1.0, 1e-9], 64)
    said: list[tuple[str, int, int]] = []
    config = FitConfig(mean_terms=2.0, max_terms=8, width_price=0.0)
    fit = fit_srbf(scene(128), config=config, importance=importance, progress=lambda *call: said.append(call))
    assert fit.colors.counts[:64].mean() > 3.0
    assert fit.colors.counts[64:].mean() < 0.1
    assert (said[-3], said[-1]) == (("fit", 0, 128), ("fit", 128, 128))
    assert 0.7 * 128 < said[-2][1] < 128


def test_foreseen_work_is_that_of_gaussians_as_important() -> None:
    rng = np.random.default_rng(0)
    importance = rng.uniform(size=20_000) ** 4
    terms = np.minimum(20.0 * importance, 12.0).astype(np.int64)
    exact = 1.0 + 0.8 * terms + 0.08 * terms**2
    order = np.argsort(-importance)
    sample = order[::5]
    work = foresee_work(importance, importance[sample], terms[sample])
    parts = [slice(start, min(start + 900, 20_000)) for start in range(0, 20_000, 900)]
    done = count_progress(work[order], parts)
    truth = np.cumsum(exact[order])[[part.stop - 1 for part in parts]] / exact.sum()
    np.testing.assert_allclose(np.array(done) / 20_000, truth, atol=0.01)
    assert done[-1] == 20_000


def test_even_work_counts_gaussians() -> None:
    parts = [slice(0, 4), slice(4, 8), slice(8, 9)]
    assert count_progress(np.ones(9), parts) == [4, 8, 9]
    assert count_progress(np.ones(0), []) == []
    same = foresee_work(np.ones(5), np.ones(3), np.array([0, 3, 6]))
    assert np.ptp(same) == 0.0


def test_terms_go_where_they_count() -> None:
    g, faces = scene(400), caps(400)
    importance = np.random.default_rng(0).lognormal(sigma=2.0, size=400)
    config = FitConfig(mean_terms=1.0, max_terms=6)
    aware, blind = fit_srbf(g, faces, config, importance=importance), fit_srbf(g, faces, config)
    assert (aware.errors * importance).sum() < 0.8 * (blind.errors * importance).sum()


@pytest.mark.parametrize("name", list(VARIANTS))
def test_degenerate_gaussians_get_defined_colors(name: str) -> None:
    g = scene(8)
    sh0, higher = g.sh0.copy(), g.shN.copy()
    higher[:4] = 0.0  # no change with direction:
    sh0[0], sh0[1], sh0[2] = 0.0, -1e3, 1e3  # gray, black (far below 0), far above 1
    higher[4], sh0[4] = higher[4, :, :1], 0.3  # gray in every direction
    higher[5] *= 1e4  # far outside of [0, 1]
    scenes = Gaussians(g.means, g.quats, g.scales, g.opacities, sh0, higher)
    faces = np.ones((8, 80), bool)
    faces[6] = False  # never seen
    faces[7, 1:] = False  # from a single face
    fit = fit_srbf(scenes, faces, FitConfig(variant=name, mean_terms=None))
    shown = evaluate_along(fit.colors, POINTS)
    assert np.isfinite(shown).all()
    assert np.isfinite(fit.errors).all()
    assert fit.unseen == 1
    assert fit.colors.counts[6] == 0
    assert not fit.colors.counts[:4].any()
    truth = sample_colors(scenes).transpose(0, 2, 1)
    np.testing.assert_allclose(shown[:4], truth[:4], rtol=1e-5, atol=1e-5)
    assert fit.colors.counts[7] <= 1 * len(VARIANTS[name].functions)  # four points carry one term at the most


def test_no_terms_and_no_gaussians() -> None:
    g = scene(5)
    fit = fit_srbf(g, None, FitConfig(max_terms=0))
    assert fit.colors.num_terms == 0
    weights = SHARES / SHARES.sum()
    np.testing.assert_allclose(fit.colors.base, sample_colors(g) @ weights, atol=1e-5)
    assert len(fit_srbf(g[:0], None).colors) == 0


def test_lobes_that_made_a_function_are_found() -> None:
    centers = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, -0.8, -0.6]])
    decays, intensities = np.array([4.0, 9.0, 2.0]), np.array([1.0, -0.6, 0.5])
    values = (intensities * srbf(POINTS[:, None], centers, decays)).sum(axis=1)
    starts = np.concatenate([decay * icosphere(1)[0] for decay in (1.5, 6.0)])
    dictionary = np.exp(starts @ POINTS.T - np.linalg.norm(starts, axis=1)[:, None]).astype(np.float32)
    v, a = np.zeros((1, 3, 3), np.float32), np.zeros((1, 3, 1), np.float32)
    counts, curves = np.zeros(1, np.int64), np.zeros((1, 4), np.float32)
    wide = np.zeros((1, 4), np.float32)
    limits = (1e-9, 0.1, 60.0, 1e-6, 200.0, 0.0, 0.0, 0.02)
    fit_lobes(
        np.ascontiguousarray(POINTS.T, np.float32), dictionary, starts, values.astype(np.float32)[None, None],
        np.ones((1, 320), np.float32), np.ones(1), np.array([3]), 0.0, limits, v, a, counts, curves, wide,
    )  # fmt: skip
    found = np.linalg.norm(v[0], axis=1)
    order = [int(np.argmax(v[0] @ c / found)) for c in centers]
    assert sorted(order) == [0, 1, 2]
    assert curves[0, 3] < 1e-4 * curves[0, 0]
    np.testing.assert_allclose(found[order], decays, rtol=0.1)
    np.testing.assert_allclose(a[0, order, 0], intensities, atol=0.05)


def active_shares(fit: SrbfFit, faces: np.ndarray) -> np.ndarray:
    """(T,) weighted share of the seen directions along which each term changes a channel by more than 0.02."""
    colors = fit.colors
    weights = np.repeat(faces, 4, axis=1) * SHARES
    weights /= weights.sum(axis=1, keepdims=True)
    lobes = srbf(POINTS, unit_vectors(colors.centers)[:, None], colors.decays[:, None])
    changes = np.abs(colors.amplitudes()).max(axis=1, keepdims=True) * lobes
    return ((changes > 0.02) * weights[colors.gaussian_ids]).sum(axis=1)


def test_a_price_for_width_narrows_terms_and_costs_little() -> None:
    g, faces = scene(300, spread=0.08), caps(300)
    free, priced = (
        fit_srbf(g, faces, FitConfig(max_terms=8, mean_terms=2.0, width_price=price, width_loss=np.inf))
        for price in (0.0, 3.0)
    )
    assert priced.width_price == 3.0
    shares = [active_shares(fit, faces) for fit in (free, priced)]
    assert shares[1].mean() < 0.9 * shares[0].mean()
    assert priced.colors.num_terms <= 2.02 * len(g)
    assert priced.errors.mean() < 1.3 * free.errors.mean()


def test_the_price_for_width_costs_no_more_than_its_loss() -> None:
    """With a loss of 0 colors are those without a price; with a little they are narrower, and errors grow by it."""
    g, faces = scene(300, spread=0.08), caps(300)
    free, none, little = (
        fit_srbf(g, faces, FitConfig(max_terms=8, mean_terms=2.0, width_price=price, width_loss=loss))
        for price, loss in ((0.0, 0.1), (9.0, 0.0), (9.0, 0.1))
    )
    np.testing.assert_array_equal(none.colors.intensities, free.colors.intensities)
    assert none.width_price == 0.0 < little.width_price < 9.0
    assert active_shares(little, faces).mean() < active_shares(free, faces).mean()
    assert little.errors.mean() < 1.03 * free.errors.mean()
    for loss in (5000.0, np.inf):
        any_loss = FitConfig(max_terms=2, mean_terms=1.0, width_price=9.0, width_loss=loss)
        assert fit_srbf(g[:20], faces[:20], any_loss).width_price == 9.0


def test_widths_in_the_kernel_are_those_of_the_terms() -> None:
    g, faces = scene(20), caps(20).astype(np.float32)
    weights = np.repeat(faces, 4, axis=1) * SHARES.astype(np.float32)
    pursuit = Pursuit(FitConfig(max_terms=3))
    (lobes,) = pursuit.fit(sample_colors(g), weights, np.ones(20), 0.0, np.zeros(20, bool)).lobes
    fit = fit_srbf(g, faces, FitConfig(max_terms=3, mean_terms=None))
    summed = np.bincount(fit.colors.gaussian_ids, active_shares(fit, faces), len(g))
    np.testing.assert_allclose(lobes.wide[np.arange(20), lobes.counts], summed, atol=1e-3)


@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("terms", [1, 3])
def test_refinement_is_as_good_as_scipys(terms: int, channels: int) -> None:
    rng = np.random.default_rng(terms)
    points = np.zeros((4, 320), np.float32)
    points[:3], points[3] = POINTS.T, np.sqrt(rng.uniform(0.2, 1.0, 320))
    truth = sample_colors(scene(1, seed=terms))[0].T[:, :channels]
    truth = truth - truth.mean(axis=0)
    targets = np.zeros((4, 320), np.float32)
    targets[:channels] = (truth * points[3][:, None]).T
    total = float(np.square(targets.astype(np.float64)).sum())
    best, found = reference.refine(truth, POINTS, points[3] ** 2, rng.normal(scale=3.0, size=(terms, 3)), ridge=0.01)
    nearby = found * rng.uniform(0.9, 1.1, found.shape)
    w, v, a = work(terms, 320, channels), nearby.copy(), np.zeros((terms, channels))
    find_products(w, points, targets, 320, terms, channels, v)
    refine(w, points, targets, 320, total, terms, channels, v, a, (0.01, 1e-3, 1e3, 1e-9, 300.0, 0.0, 0.0, 0.02))
    decays = np.linalg.norm(v, axis=1)
    lobes = np.exp(points[:3].T.astype(np.float64) @ v.T - decays)
    left = np.square((truth - lobes @ a) * points[3][:, None]).sum() + 0.01 * np.square(a).sum()
    assert left <= 1.02 * best + 1e-4 * total


def test_products_of_one_lobe_more_are_those_of_all() -> None:
    rng = np.random.default_rng(6)
    points = np.zeros((4, 320), np.float32)
    points[:3], points[3] = POINTS.T, rng.uniform(0.2, 1.0, 320)
    targets = np.zeros((4, 320), np.float32)
    targets[:3] = rng.normal(size=(3, 320))
    v = rng.normal(scale=3.0, size=(5, 3))
    one, whole = work(5, 320, 3), work(5, 320, 3)
    for terms in range(5):
        add_lobe(one, points, targets, 320, terms, 3, v)
    find_products(whole, points, targets, 320, 5, 3, v)
    for name in ("rows", "inner", "outer"):
        np.testing.assert_allclose(getattr(one, name), getattr(whole, name), rtol=1e-5, atol=1e-6)


@settings(max_examples=25, deadline=None, derandomize=True)
@given(st.integers(0, 10_000), st.floats(1e-6, 1e3), st.sampled_from(list(VARIANTS)))
def test_never_nan(seed: int, spread: float, name: str) -> None:
    g = scene(4, seed=seed, spread=spread)
    fit = fit_srbf(g, caps(4, seed), FitConfig(variant=name, max_terms=3, mean_terms=None))
    assert np.isfinite(evaluate_along(fit.colors, POINTS)).all()
    assert np.all(fit.errors <= fit.base_errors * (1 + 1e-4) + 1e-9)


def test_bad_arguments_are_named() -> None:
    g = scene(3)
    for bad, match in (
        ({"directions": np.ones((2, 80))}, "directions: expected uint8 sets"),
        ({"directions": -np.ones((3, 80))}, "directions: expected values"),
        ({"importance": np.full(3, np.nan)}, "importance: expected finite"),
        ({"importance": np.ones(2)}, "importance: expected shape"),
    ):
        with pytest.raises(ValueError, match=match):
            options: dict[str, Any] = {"directions": None, **bad}
            fit_srbf(g, **options)
    for wrong, match in (
        ({"variant": "lab"}, "variant: expected one of"),
        ({"max_terms": -1}, "max_terms: expected"),
        ({"max_terms": 33}, "max_terms: expected 0 to 32"),
        ({"mean_terms": -1.0}, "mean_terms: expected"),
        ({"decays": ()}, "decays: expected at least one"),
        ({"ridge": float("nan")}, "ridge: expected"),
        ({"width_price": -1.0}, "width_price: expected"),
        ({"width_loss": float("nan")}, "width_loss: expected"),
        ({"epsilon": 0.0}, "epsilon: expected"),
    ):
        with pytest.raises(ValueError, match=match):
            FitConfig(**wrong)
