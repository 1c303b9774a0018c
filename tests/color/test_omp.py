"""Orthogonal matching pursuit: against its plain twin and scikit-learn, and the laws it keeps."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numba import get_num_threads, set_num_threads

from gsvis.color import SparseCodes, orthogonal_matching_pursuit, reference, srbf_dictionary
from gsvis.color._kernels.products import BLOCK
from gsvis.scene.icosphere import icosphere


def problem(seed: int, number: int = 40, depth: int = 42, atoms: int = 70) -> tuple[np.ndarray, np.ndarray]:
    """Atoms of many lengths, and signals that few of them nearly make."""
    rng = np.random.default_rng(seed)
    dictionary = rng.normal(size=(depth, atoms)) * rng.uniform(0.01, 10.0, atoms)
    parts = np.where(rng.random((number, atoms)) < 0.1, rng.normal(size=(number, atoms)), 0.0)
    return dictionary, (parts @ dictionary.T + 0.3 * rng.normal(size=(number, depth))).astype(np.float32)


def lobes(decays: tuple[float, ...] = (4.0, 16.0)) -> np.ndarray:
    vertices, _ = icosphere(2)
    return srbf_dictionary(vertices, vertices, decays).values


def some_weights(kind: str, number: int, depth: int) -> np.ndarray | None:
    rng = np.random.default_rng(3)
    if kind == "none":
        return None
    if kind == "shared":
        return rng.uniform(0.0, 2.0, depth) * (rng.random(depth) < 0.8)
    mask = rng.random((number, depth)) < rng.uniform(0.2, 1.0, (number, 1))
    return mask if kind == "mask" else mask * rng.uniform(0.0, 30.0, (number, depth)).astype(np.float32)


def fitted(dictionary: np.ndarray, codes: SparseCodes) -> np.ndarray:
    """What the codes stand for: (N, D) or (N, D, C)."""
    picked = np.where(codes.atoms >= 0, dictionary[:, codes.atoms], 0.0)
    return np.einsum("dnk,nk...->nd...", picked, codes.coefficients.astype(np.float64))


def squared_error(signals: np.ndarray, fit: np.ndarray, weights: np.ndarray | None) -> np.ndarray:
    squares = (signals.astype(np.float64) - fit) ** 2
    squares = squares if squares.ndim == 2 else squares.sum(axis=2)
    return (squares if weights is None else squares * weights).sum(axis=1)


def assert_same(fast: SparseCodes, plain: SparseCodes) -> None:
    scale = np.maximum(plain.errors[:, :1], 1e-300)
    np.testing.assert_array_equal(fast.atoms, plain.atoms)
    np.testing.assert_array_equal(fast.counts, plain.counts)
    np.testing.assert_allclose(fast.errors / scale, plain.errors / scale, rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(fast.coefficients, plain.coefficients, rtol=2e-4, atol=1e-4)


def assert_identical(a: SparseCodes, b: SparseCodes) -> None:
    for name in ("atoms", "coefficients", "counts", "errors"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))


@pytest.mark.parametrize("channels", [0, 1, 3])
@pytest.mark.parametrize("kind", ["none", "shared", "mask", "weights"])
def test_the_fast_way_equals_the_plain_one(kind: str, channels: int) -> None:
    dictionary, signals = problem(1)
    if channels:
        signals = (
            np.random.default_rng(5).normal(size=(*signals.shape, channels)).astype(np.float32) + signals[..., None]
        )
    weights = some_weights(kind, *signals.shape[:2])
    fast = orthogonal_matching_pursuit(dictionary, signals, max_terms=5, weights=weights)
    assert_same(fast, reference.orthogonal_matching_pursuit(dictionary, signals, max_terms=5, weights=weights))
    assert fast.coefficients.shape == (len(signals), 5, *signals.shape[2:])
    np.testing.assert_allclose(
        fast.errors[:, -1], squared_error(signals, fitted(dictionary, fast), weights), rtol=1e-4, atol=1e-4
    )


@pytest.mark.parametrize("kind", ["none", "mask"])
def test_coherent_atoms_leave_the_same_error(kind: str) -> None:
    # Neighboring wide lobes are nearly the same function: an early choice may be a matter of rounding, the error not.
    dictionary = lobes((0.2, 0.5, 1.0, 40.0))
    rng = np.random.default_rng(2)
    signals = (rng.normal(size=(12, 60)) @ dictionary[:, rng.permutation(648)[:60]].T).astype(np.float32)
    weights = some_weights(kind, *signals.shape)
    fast = orthogonal_matching_pursuit(dictionary, signals, max_terms=10, weights=weights)
    plain = reference.orthogonal_matching_pursuit(dictionary, signals, max_terms=10, weights=weights)
    scale = plain.errors[:, :1]
    np.testing.assert_allclose(fast.errors / scale, plain.errors / scale, rtol=2e-2, atol=1e-7)
    assert np.mean(fast.atoms == plain.atoms) > 0.95
    np.testing.assert_allclose(
        squared_error(signals, fitted(dictionary, fast), weights) / scale[:, 0], fast.errors[:, -1] / scale[:, 0],
        rtol=1e-3, atol=1e-5,
    )  # fmt: skip


def test_supports_and_errors_are_those_of_scikit_learn() -> None:
    linear_model = pytest.importorskip("sklearn.linear_model")
    dictionary = lobes()
    dictionary /= np.linalg.norm(dictionary, axis=0)
    rng = np.random.default_rng(4)
    signals = (rng.normal(size=(200, 16)) @ rng.normal(size=(16, 162))).astype(np.float32)
    theirs = linear_model.orthogonal_mp_gram(
        dictionary.T @ dictionary, dictionary.T @ signals.T.astype(np.float64), n_nonzero_coefs=6
    ).T
    ours = orthogonal_matching_pursuit(dictionary, signals, max_terms=6)
    dense = np.zeros_like(theirs)
    np.put_along_axis(dense, ours.atoms.astype(np.int64), ours.coefficients.astype(np.float64), axis=1)
    np.testing.assert_array_equal(dense != 0.0, theirs != 0.0)
    np.testing.assert_allclose(dense, theirs, rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(ours.errors[:, -1], squared_error(signals, theirs @ dictionary.T, None), rtol=1e-5)


def test_what_few_atoms_make_is_found_again() -> None:
    rng = np.random.default_rng(6)
    dictionary = np.linalg.qr(rng.normal(size=(50, 50)))[0] * 3.0
    chosen = np.array([rng.permutation(50)[:4] for _ in range(30)])
    parts = np.sort(rng.uniform(1.0, 9.0, (30, 4)))[:, ::-1]
    signals = np.einsum("dnk,nk->nd", dictionary[:, chosen], parts)
    codes = orthogonal_matching_pursuit(dictionary, signals, max_terms=9)
    np.testing.assert_array_equal(codes.counts, 4)  # it ends where nothing is left
    np.testing.assert_array_equal(codes.atoms[:, :4], chosen)
    np.testing.assert_array_equal(codes.atoms[:, 4:], -1)
    np.testing.assert_allclose(codes.coefficients[:, :4], parts, rtol=1e-5)


@pytest.mark.parametrize("kind", ["none", "shared", "mask", "weights"])
def test_errors_never_rise_and_more_terms_continue_fewer(kind: str) -> None:
    dictionary, signals = problem(7)
    weights = some_weights(kind, *signals.shape)
    long = orthogonal_matching_pursuit(dictionary, signals, max_terms=12, weights=weights)
    assert np.all(np.diff(long.errors, axis=1) <= 0.0)
    short = orthogonal_matching_pursuit(dictionary, signals, max_terms=5, weights=weights)
    np.testing.assert_array_equal(short.atoms, long.atoms[:, :5])
    np.testing.assert_array_equal(short.errors, long.errors[:, :6])


@pytest.mark.parametrize("kind", ["none", "mask"])
def test_a_signal_knows_nothing_of_the_others(kind: str) -> None:
    dictionary, signals = problem(8, number=3 * BLOCK + 5)
    weights = some_weights(kind, *signals.shape)

    def pursue(rows: np.ndarray) -> SparseCodes:
        own = weights if weights is None else weights[rows]
        return orthogonal_matching_pursuit(dictionary, signals[rows], max_terms=4, weights=own)

    def part(codes: SparseCodes, rows: np.ndarray) -> SparseCodes:
        return SparseCodes(codes.atoms[rows], codes.coefficients[rows], codes.counts[rows], codes.errors[rows])

    everything = pursue(np.arange(len(signals)))
    shuffled = np.random.default_rng(0).permutation(len(signals))
    assert_identical(pursue(shuffled), part(everything, shuffled))
    for few in (np.array([BLOCK + 3]), np.arange(7, 20)):
        assert_identical(pursue(few), part(everything, few))


def test_threads_and_chunks_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    dictionary, signals = problem(9, number=200)
    weights = some_weights("mask", *signals.shape)
    calls: list[tuple[str, int, int]] = []
    many = orthogonal_matching_pursuit(dictionary, signals, max_terms=4, weights=weights)
    threads = get_num_threads()
    monkeypatch.setattr("gsvis.color.omp._CHUNK", BLOCK + 1)
    try:
        set_num_threads(1)
        one = orthogonal_matching_pursuit(
            dictionary, signals, max_terms=4, weights=weights, progress=lambda *call: calls.append(call)
        )
    finally:
        set_num_threads(threads)
    assert_identical(many, one)
    assert calls[0] == ("pursuit", 0, 200)
    assert calls[-1] == ("pursuit", 200, 200)
    assert [done for _, done, _ in calls] == sorted({done for _, done, _ in calls})


@given(st.integers(0, 10_000))
def test_what_is_masked_has_no_influence(seed: int) -> None:
    dictionary, signals = problem(seed, number=6)
    rng = np.random.default_rng(seed)
    mask = rng.random(signals.shape) < 0.6
    other = np.where(mask, signals, rng.normal(size=signals.shape) * 10.0 ** rng.integers(-9, 9)).astype(np.float32)
    a, b = (orthogonal_matching_pursuit(dictionary, s, max_terms=5, weights=mask) for s in (signals, other))
    assert_identical(a, b)


@given(st.integers(0, 10_000), st.integers(-8, 8), st.integers(-6, 6))
def test_units_of_signals_and_weights_do_not_matter(seed: int, size: int, weight: int) -> None:
    dictionary, signals = problem(seed, number=6)
    weights = some_weights("weights", *signals.shape)
    plain = orthogonal_matching_pursuit(dictionary, signals, max_terms=4, weights=weights)
    scaled = orthogonal_matching_pursuit(dictionary, signals * 2.0**size, max_terms=4, weights=weights * 4.0**weight)
    np.testing.assert_array_equal(scaled.atoms, plain.atoms)
    np.testing.assert_allclose(scaled.coefficients, plain.coefficients * 2.0**size, rtol=1e-6)
    np.testing.assert_allclose(scaled.errors, plain.errors * 4.0 ** (size + weight), rtol=1e-6)


def test_weights_all_alike_are_no_weights_and_shared_ones_are_everybodys_own() -> None:
    dictionary, signals = problem(10)
    plain = orthogonal_matching_pursuit(dictionary, signals, max_terms=5)
    assert_same(orthogonal_matching_pursuit(dictionary, signals, max_terms=5, weights=np.ones_like(signals)), plain)
    shared = some_weights("shared", *signals.shape)
    assert_same(
        orthogonal_matching_pursuit(dictionary, signals, max_terms=5, weights=np.tile(shared, (len(signals), 1))),
        orthogonal_matching_pursuit(dictionary, signals, max_terms=5, weights=shared),
    )


def test_limits_and_tolerances_of_each_signal() -> None:
    dictionary, signals = problem(11)
    full = orthogonal_matching_pursuit(dictionary, signals, max_terms=6)
    limits = np.arange(len(signals)) % 7
    codes = orthogonal_matching_pursuit(dictionary, signals, max_terms=limits)
    np.testing.assert_array_equal(codes.counts, limits)
    np.testing.assert_array_equal(codes.atoms, np.where(np.arange(6) < limits[:, None], full.atoms, -1))
    np.testing.assert_array_equal(codes.errors[:, -1], full.errors[np.arange(len(signals)), limits])
    good_enough = full.errors[:, 3]
    codes = orthogonal_matching_pursuit(dictionary, signals, max_terms=6, tolerance=good_enough)
    np.testing.assert_array_equal(codes.counts, 3)
    codes = orthogonal_matching_pursuit(dictionary, signals, max_terms=6, tolerance=float(np.median(good_enough)))
    assert np.all((codes.errors[:, -1] <= np.median(good_enough)) | (codes.counts == 6))


@pytest.mark.parametrize("kind", ["none", "mask"])
def test_zero_terms_zero_signals_and_no_signals(kind: str) -> None:
    dictionary, signals = problem(12)
    weights = some_weights(kind, *signals.shape)
    none = orthogonal_matching_pursuit(dictionary, signals, max_terms=0, weights=weights)
    assert none.atoms.shape == (len(signals), 0)
    np.testing.assert_allclose(none.errors[:, 0], squared_error(signals, np.zeros_like(signals), weights), rtol=1e-5)
    zero = orthogonal_matching_pursuit(dictionary, 0.0 * signals, max_terms=3, weights=weights)
    assert not zero.counts.any()
    assert not zero.errors.any()
    own = weights if weights is None else weights[:0]
    assert orthogonal_matching_pursuit(dictionary, signals[:0], max_terms=3, weights=own).errors.shape == (0, 4)


@pytest.mark.parametrize("shared", [True, False])
def test_a_signal_never_seen_gets_no_terms(shared: bool) -> None:
    dictionary, signals = problem(13)
    weights = np.zeros(signals.shape[1] if shared else signals.shape)
    codes = orthogonal_matching_pursuit(dictionary, signals, max_terms=3, weights=weights)
    assert not codes.counts.any()
    assert not codes.errors.any()
    assert not codes.coefficients.any()
    assert np.all(codes.atoms == -1)


@pytest.mark.parametrize("kind", ["none", "mask"])
def test_the_first_of_equal_atoms_is_taken_and_never_its_double(kind: str) -> None:
    rng = np.random.default_rng(14)
    single = rng.normal(size=(30, 6))
    dictionary = np.concatenate([single, 2.0 * single, -0.5 * single, np.zeros((30, 2))], axis=1)
    signals = rng.normal(size=(20, 30))
    codes = orthogonal_matching_pursuit(dictionary, signals, max_terms=20, weights=some_weights(kind, *signals.shape))
    assert codes.atoms.max() < 6
    assert np.all(codes.counts <= 6)
    assert np.isfinite(codes.coefficients).all()


def test_single_directions_constants_and_extremes_stay_finite() -> None:
    dictionary = lobes()
    signals = np.ones((6, 162), np.float32)
    signals[1] *= 1e30
    signals[2] *= 1e-30
    signals[3] *= 1e-42  # below the normal numbers of float32
    weights = np.ones((6, 162), np.float32)
    weights[4] = np.eye(162)[7]
    weights[5] *= 1e-42
    for own in (weights, None):
        codes = orthogonal_matching_pursuit(dictionary, signals, max_terms=8, weights=own)
        assert np.isfinite(codes.coefficients).all()
        assert np.isfinite(codes.errors).all()
        assert np.all(np.diff(codes.errors, axis=1) <= 0.0)
        assert np.all(codes.errors[:5, -1] <= 0.05 * codes.errors[:5, 0])
    one = orthogonal_matching_pursuit(dictionary, signals, max_terms=8, weights=weights)
    assert one.counts[4] == 1  # one atom makes one direction exactly


def test_hidden_atoms_are_passed_over() -> None:
    vertices, _ = icosphere(2)
    dictionary = srbf_dictionary(vertices, vertices, [30.0]).values
    behind = vertices[:, 2] < 0.0
    codes = orthogonal_matching_pursuit(
        dictionary, np.random.default_rng(0).normal(size=(9, 162)), max_terms=10, weights=np.tile(behind, (9, 1)),
        least_share=0.5,
    )  # fmt: skip
    assert np.all(vertices[codes.atoms[codes.atoms >= 0], 2] < 0.2)


def test_arguments_are_left_alone_and_may_be_of_any_kind() -> None:
    dictionary, signals = problem(15)
    weights = some_weights("mask", *signals.shape)
    plain = orthogonal_matching_pursuit(dictionary, signals, max_terms=4, weights=weights)
    for array in (dictionary, signals, weights):
        array.flags.writeable = False
    assert_identical(
        orthogonal_matching_pursuit(
            dictionary, np.asfortranarray(signals), max_terms=4, weights=weights.astype(np.uint8)
        ),
        plain,
    )
    assert_identical(
        orthogonal_matching_pursuit(dictionary.tolist(), signals.tolist(), max_terms=4, weights=weights.tolist()), plain
    )


def broken(array: np.ndarray, value: float) -> np.ndarray:
    copy = np.array(array, np.float64)
    copy[(3, 2)] = value
    return copy


BAD = {
    "dictionary: expected finite": {"dictionary": lambda d: broken(d, np.nan)},
    "dictionary: expected at least one": {"dictionary": lambda d: d[:, :0]},
    "signals: expected shape": {"signals": lambda s: s[:, :-1]},
    "signals: expected finite values .* got a value that is infinite, NaN or too large in row 3": {
        "signals": lambda s: broken(s, np.inf)
    },
    "signals: expected finite values": {"signals": lambda s: broken(s, 1e300)},
    "signals: expected numbers": {"signals": lambda s: s.astype(complex)},
    "weights: expected shape": {"weights": lambda w: w[:, 1:]},
    "weights: expected finite values in the range of float32 and not negative": {"weights": lambda w: broken(w, -1.0)},
    "weights: expected finite values .* got a value .* or negative in row 3": {"weights": lambda w: broken(w, np.nan)},
    "weights: expected values": {"weights": lambda w: -w[0] - 1.0},
    "max_terms: expected 0 to 70, the number of atoms, got 71": {"max_terms": lambda _: 71},
    "max_terms: expected an integer": {"max_terms": lambda _: -1},
    "max_terms: expected shape": {"max_terms": lambda _: [1, 2]},
    "tolerance: expected values": {"tolerance": lambda _: -1.0},
    "tolerance: expected finite": {"tolerance": lambda _: np.nan},
    "least_share: expected": {"least_share": lambda _: 2.0},
}


@pytest.mark.parametrize("message", BAD)
def test_bad_input_is_named(message: str) -> None:
    dictionary, signals = problem(16)
    arguments = {"dictionary": dictionary, "signals": signals, "weights": np.ones(signals.shape), "max_terms": 3}
    for name, spoil in BAD[message].items():
        arguments[name] = spoil(arguments.get(name))
    with pytest.raises(ValueError, match=message):
        orthogonal_matching_pursuit(arguments.pop("dictionary"), arguments.pop("signals"), **arguments)


def test_a_dictionary_holds_every_center_with_every_decay() -> None:
    directions, centers = np.eye(3), np.array([[0.0, 0.0, 2.0], [3.0, 0.0, 0.0]])
    dictionary = srbf_dictionary(directions, centers, [8.0, 2.0])
    np.testing.assert_array_equal(dictionary.decays, [2.0, 2.0, 8.0, 8.0])
    np.testing.assert_array_equal(dictionary.centers, [[0, 0, 1], [1, 0, 0]] * 2)
    np.testing.assert_allclose(dictionary.values[2], [1.0, np.exp(-2.0), 1.0, np.exp(-8.0)])
    assert len(dictionary) == 4
    with pytest.raises(ValueError, match="centers: expected non-zero"):
        srbf_dictionary(directions, np.zeros((1, 3)), [1.0])
    with pytest.raises(ValueError, match="decays"):
        srbf_dictionary(directions, centers, [-1.0])
