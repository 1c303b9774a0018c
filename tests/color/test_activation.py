"""What terms contribute, against loops over equation 3 and the spaces, and which are active from an eye or a box."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from gsvis.color import spaces
from gsvis.color.activation import Activation, active, active_in_box, contributions
from gsvis.color.evaluate import evaluate
from gsvis.color.srbf import SrbfColors, srbf, unit_vectors
from gsvis.color.variants import VARIANTS
from tests.color.samples import random_colors


def color(colors: SrbfColors, gaussian: int, values: NDArray[np.float64]) -> NDArray[np.float64]:
    """RGB of one Gaussian's values in the variant's space, kept within it."""
    values = np.concatenate([values[:1], np.clip(values[1:], 0.0, 1.0)])
    return np.maximum(spaces.hsl_to_rgb(values) * colors.scales[gaussian].astype(np.float64), 0.0)


def naive(colors: SrbfColors, means: NDArray[np.float64], eye: NDArray[np.float64]) -> NDArray[np.float64]:
    """Contributions term by term."""
    out = np.zeros(colors.num_terms)
    amplitudes = colors.amplitudes().astype(np.float64)
    for i in range(len(colors)):
        way = means[i] - eye
        way = way / np.linalg.norm(way)
        terms = range(colors.offsets[i], colors.offsets[i + 1])
        added = {t: amplitudes[t] * srbf(way, unit_vectors(colors.centers[t]), colors.decays[t]) for t in terms}
        total = colors.base[i].astype(np.float64) + sum(added.values())
        for t in terms:
            if colors.kind.space == "rgb":
                out[t] = np.abs(added[t]).max()
            else:
                out[t] = np.abs(color(colors, i, total) - color(colors, i, total - added[t])).max()
    return out


def single(center: tuple[float, float], decay: float, intensity: tuple[float, float, float]) -> SrbfColors:
    """One gray Gaussian with one lobe."""
    return SrbfColors("rgb", [[0.5, 0.5, 0.5]], [1.0], [0, 1], [0], [center], [decay], [intensity])


def test_a_lobe_seen_from_its_center_adds_its_intensity() -> None:
    lobe = single((0.0, 0.0), 10.0, (0.1, -0.3, 0.2))
    assert contributions(lobe, [[1, 2, 3]], [1, 2, 0])[0] == pytest.approx(0.3)
    # A right angle away it is down to exp(-decay), at the back to exp(-2 decay).
    assert contributions(lobe, [[1, 2, 3]], [0, 2, 3])[0] == pytest.approx(0.3 * np.exp(-10))
    assert contributions(lobe, [[1, 2, 3]], [1, 2, 9])[0] == pytest.approx(0.3 * np.exp(-20))


def test_an_eye_in_the_center_has_a_direction() -> None:
    assert contributions(single((0.0, 0.0), 3.0, (0.2, 0, 0)), [[1, 1, 1]], [1, 1, 1])[0] == pytest.approx(0.2)


def test_lightness_moves_all_channels_of_gray_by_scale_times_intensity() -> None:
    gray = SrbfColors("hsl", [[0, 0, 0.5]], [2.0], [0, 1], [1], [[0, 0]], [5.0], [[-0.25]])
    assert contributions(gray, [[0, 0, 1]], [0, 0, 0])[0] == pytest.approx(2.0 * 0.5 * 0.25)


def test_a_term_that_only_darkens_black_adds_nothing() -> None:
    black = SrbfColors("hsl", [[0.1, 0.5, 0.0]], [1.0], [0, 1], [1], [[0, 0]], [5.0], [[-3.0]])
    assert contributions(black, [[0, 0, 1]], [0, 0, 0])[0] == 0.0


@pytest.mark.parametrize("name", VARIANTS)
def test_contributions_agree_with_loops(name: str) -> None:
    rng = np.random.default_rng(7)
    colors, means = random_colors(rng, 80, name), rng.normal(size=(80, 3)).astype(np.float32)
    for eye in rng.normal(scale=2.0, size=(3, 3)):
        expected = naive(colors, means.astype(np.float64), eye)
        found = contributions(colors, means, eye)
        assert found.dtype == np.float32
        np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-6)
        assert np.array_equal(active(colors, means, eye, 0.03), found > np.float32(0.03))


@settings(max_examples=40)
@given(
    st.sampled_from(sorted(VARIANTS)),
    st.integers(0, 10_000),
    st.floats(-3.0, 0.5),
    st.sampled_from([1e-4, 0.004, 0.02, 0.1]),
)
def test_a_box_misses_no_term_that_is_active_for_an_eye_in_it(
    name: str, seed: int, size: float, epsilon: float
) -> None:
    rng = np.random.default_rng(seed)
    colors, means = random_colors(rng, 60, name), rng.normal(size=(60, 3)).astype(np.float32)
    activation = Activation(colors, means, epsilon)
    half = 10.0**size * rng.uniform(0.2, 1.0, 3)
    middle = rng.normal(scale=1.5, size=3)
    low, high = middle - half, middle + half
    weights = rng.random(60).astype(np.float32)
    possible, weighted = activation.active_in_box(low, high), activation.active_in_box(low, high, weights=weights)
    assert not (weighted & ~possible).any()
    corners = np.stack(np.meshgrid(*zip(low, high, strict=True), indexing="ij"), axis=-1).reshape(-1, 3)
    for eye in [*corners, *rng.uniform(low, high, (24, 3))]:
        assert not (activation.active(eye) & ~possible).any()
        assert not (activation.active(eye, weights=weights) & ~weighted).any()


@pytest.mark.parametrize("decay", [0.05, 3.0, 300.0, 1e4])
def test_a_point_is_a_box_without_room_for_error(decay: float) -> None:
    rng = np.random.default_rng(3)
    count = 4000
    near = rng.normal(scale=min(2.0, 1.5 / np.sqrt(decay)), size=(count, 2))
    colors = SrbfColors(
        "rgb", np.full((count, 3), 0.5), np.ones(count), np.arange(count + 1),
        np.zeros(count, int), np.abs(near), np.full(count, decay), rng.uniform(0.02, 0.5, (count, 3)),
    )  # fmt: skip
    means = np.tile([0.0, 0.0, 1.0], (count, 1))
    activation = Activation(colors, means, 0.05)
    exact, boxed = activation.active([0, 0, 0]), activation.active_in_box([0, 0, 0], [0, 0, 0])
    assert not (exact & ~boxed).any()
    assert exact.sum() <= boxed.sum() <= exact.sum() + 0.01 * count


def test_larger_boxes_and_smaller_thresholds_have_more_terms() -> None:
    rng = np.random.default_rng(5)
    colors, means = random_colors(rng, 500, "rgb"), rng.normal(size=(500, 3))
    before = np.zeros(colors.num_terms, bool)
    for half in (0.0, 0.1, 0.4, 2.0, 50.0):
        now = active_in_box(colors, means, np.full(3, 1.0 - half), np.full(3, 1.0 + half), 0.02)
        assert not (before & ~now).any()
        before = now
    counts = [active(colors, means, [1, 1, 1], epsilon).sum() for epsilon in (0.0, 0.01, 0.1, 1.0, 100.0)]
    assert counts == sorted(counts, reverse=True)
    assert counts[-1] == 0
    assert not active_in_box(colors, means, [-9, -9, -9], [9, 9, 9], 100.0).any()


def test_inside_the_box_every_direction_counts() -> None:
    lobe = single((0.0, 0.0), 5000.0, (0.2, 0.2, 0.2))
    assert active_in_box(lobe, [[0, 0, 0]], [-1, -1, -1], [1, 1, 1], 0.1)[0]
    assert not active_in_box(lobe, [[0, 0, 0]], [-1, -1, -1], [1, 1, 1], 0.21)[0]
    # A box far to the side of the lobe never sees it.
    assert not active_in_box(lobe, [[0, 0, 0]], [5, -1, -1], [7, 1, 1], 0.1)[0]


def test_only_terms_of_visible_gaussians_are_given() -> None:
    rng = np.random.default_rng(9)
    colors, means = random_colors(rng, 200, "hsl"), rng.normal(size=(200, 3))
    activation = Activation(colors, means, 0.01)
    ids = np.flatnonzero(rng.random(200) < 0.3)
    theirs = np.isin(colors.gaussian_ids, ids)
    eye, low, high = np.array([0.1, 0.2, 0.3]), np.zeros(3), np.ones(3)
    assert np.array_equal(activation.active(eye, ids), activation.active(eye) & theirs)
    boxed = activation.active_in_box(low, high)
    assert np.array_equal(activation.active_in_box(low, high, ids), boxed & theirs)
    assert not activation.active_in_box(low, high, np.zeros(0, np.int64)).any()


def test_weights_scale_what_terms_contribute() -> None:
    rng = np.random.default_rng(17)
    colors, means = random_colors(rng, 200, "rgb"), rng.normal(size=(200, 3))
    activation = Activation(colors, means, 0.02)
    ids, eye = np.flatnonzero(rng.random(200) < 0.5), np.array([1.0, 1.0, 0.5])
    weights = rng.random(len(ids)).astype(np.float32)
    factors = np.zeros(200, np.float32)
    factors[ids] = weights
    expected = contributions(colors, means, eye) * factors[colors.gaussian_ids] > np.float32(0.02)
    assert np.array_equal(activation.active(eye, ids, weights), expected)
    for ask in (activation.active, lambda *a: activation.active_in_box([0, 0, 0], [1, 1, 1], *a[1:])):
        assert np.array_equal(ask(eye, ids, np.ones(len(ids))), ask(eye, ids))
        assert not ask(eye, ids, np.zeros(len(ids))).any()
    nothing_matters_less = Activation(colors, means, 0.0)
    assert not nothing_matters_less.active_in_box([0, 0, 0], [1, 1, 1], ids, np.zeros(len(ids))).any()


def test_active_terms_alone_change_the_color_little() -> None:
    """Terms left out at epsilon change a channel by at most epsilon each."""
    rng = np.random.default_rng(11)
    colors, means, eye = random_colors(rng, 300, "rgb"), rng.normal(size=(300, 3)), np.array([0.5, 2.0, -1.0])
    found = contributions(colors, means, eye)
    mask = active(colors, means, eye, 0.02)
    left = np.bincount(colors.gaussian_ids[~mask], found[~mask], len(colors))
    assert (left <= 0.02 * colors.counts + 1e-6).all()


def test_no_terms_and_no_gaussians() -> None:
    plain = SrbfColors.without_terms([[0.1, 0.2, 0.3]])
    assert contributions(plain, [[0, 0, 0]], [1, 1, 1]).shape == (0,)
    assert active_in_box(plain, [[0, 0, 0]], [0, 0, 0], [1, 1, 1], 0.1).shape == (0,)
    nobody = SrbfColors.without_terms(np.zeros((0, 3)))
    assert active(nobody, np.zeros((0, 3)), [1, 1, 1], 0.1).shape == (0,)


def test_bad_arguments_are_named() -> None:
    lobe = single((0.0, 0.0), 10.0, (0.1, 0.1, 0.1))
    means = [[0.0, 0.0, 1.0]]
    for epsilon in (-0.1, np.nan, np.inf, "0.1"):
        with pytest.raises(ValueError, match="epsilon: expected"):
            active(lobe, means, [0, 0, 0], epsilon)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="colors / means: expected one length"):
        contributions(lobe, np.zeros((2, 3)), [0, 0, 0])
    with pytest.raises(ValueError, match="eye: expected finite"):
        contributions(lobe, means, [0, np.nan, 0])
    with pytest.raises(ValueError, match="colors: expected SrbfColors"):
        contributions(means, means, [0, 0, 0])  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="low: expected at most high"):
        active_in_box(lobe, means, [0, 0, 1], [1, 1, 0], 0.1)
    with pytest.raises(ValueError, match=r"visible: expected ids in \[0, 1\)"):
        Activation(lobe, means, 0.1).active([0, 0, 0], [1])
    with pytest.raises(ValueError, match=r"weights: expected shape \(1,\)"):
        Activation(lobe, means, 0.1).active([0, 0, 0], [0], [0.5, 0.5])
    with pytest.raises(ValueError, match=r"weights: expected values in \[0, 1\]"):
        Activation(lobe, means, 0.1).active_in_box([0, 0, 0], [1, 1, 1], weights=[1.5])
    with pytest.raises(ValueError, match="visible: expected integers"):
        Activation(lobe, means, 0.1).active_in_box([0, 0, 0], [1, 1, 1], [0.5])


@pytest.mark.parametrize("name", VARIANTS)
def test_a_contribution_is_what_evaluation_loses_without_the_term(name: str) -> None:
    rng = np.random.default_rng(13)
    colors, means, eye = random_colors(rng, 60, name), rng.normal(size=(60, 3)), np.array([1.0, -0.5, 2.0])
    found, full = contributions(colors, means, eye), evaluate(colors, means, eye)
    for rank in range(int(colors.counts.max())):
        left_out = colors.ranks == rank
        change = np.abs(evaluate(colors, means, eye, active=~left_out) - full).max(axis=1)
        changed = change[colors.gaussian_ids[left_out]]
        if colors.kind.space == "rgb":  # a color clipped at 0 changes by less
            assert (changed <= found[left_out] + 1e-6).all()
            free = (full > 0.3).all(axis=1)[colors.gaussian_ids[left_out]] & (found[left_out] < 0.3)
            np.testing.assert_allclose(changed[free], found[left_out][free], atol=1e-6)
        else:
            np.testing.assert_allclose(changed, found[left_out], atol=2e-6)


@pytest.mark.parametrize("scale", [2.5, 1e-3])
def test_a_term_in_a_box_is_bounded_by_what_its_space_lets_it_change(scale: float) -> None:
    base = [0.3, 0.5, 0.3]  # a term multiplies its component: 0.1 of 0.3
    change = 0.03 * 1.5  # the largest channel is L + S min(L, 1 - L): slope 1 + S
    lobe = SrbfColors("hsl", [base], [scale], [0, 1], [1], [[0, 0]], [1e3], [[0.1]])
    box = [0.0, 0.0, -1.0], [0.0, 0.0, -1.0]  # the eye stands where the lobe is largest
    assert active_in_box(lobe, [[0, 0, 0]], *box, 0.99 * scale * change).tolist() == [True]
    assert active_in_box(lobe, [[0, 0, 0]], *box, 1.01 * scale * change).tolist() == [False]


def test_a_box_misses_no_term_of_a_color_whose_steps_are_larger_than_the_threshold() -> None:
    """A step of float32 at a scale of 1000 is about 3e-5: what evaluation finds is a multiple of it."""
    rng, count, scale, epsilon = np.random.default_rng(19), 300, 1000.0, 2e-5
    base = rng.uniform(0.2, 0.8, (count, 3))
    changes = rng.uniform(0.2, 0.9, count) * epsilon / scale  # below the threshold, before they are rounded
    colors = SrbfColors(
        "hsl", base, np.full(count, scale), np.arange(count + 1), np.ones(count, int),
        np.zeros((count, 2)), np.full(count, 5.0), (changes / base[:, 2])[:, None],
    )  # fmt: skip
    activation, eye = Activation(colors, np.zeros((count, 3)), epsilon), [0.0, 0.0, -1.0]
    exact = activation.active(eye)
    assert exact.any()
    assert not (exact & ~activation.active_in_box(eye, eye)).any()


@pytest.mark.parametrize("name", VARIANTS)
def test_blocks_change_no_bit(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(8)
    colors = random_colors(rng, 60, name)
    means = rng.normal(size=(60, 3))
    whole = Activation(colors, means, 0.01).least_cosines()
    monkeypatch.setattr("gsvis.color.activation._BLOCK", 16)
    assert colors.num_terms > 16
    assert Activation(colors, means, 0.01).least_cosines().tobytes() == whole.tobytes()
