"""Argument checks: what passes is handed on unchanged and uncopied; what does not is named."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from gsvis import _check


def test_a_fitting_array_is_not_copied() -> None:
    floats, integers = np.zeros((4, 3), np.float32), np.zeros(4, np.int64)
    assert _check.floats("x", floats, ("N", 3)) is floats
    assert _check.integers("x", integers, ("N",)) is integers


def test_lists_layouts_and_dtypes_are_coerced_and_the_argument_left_alone() -> None:
    source = np.arange(6, dtype=">f8").reshape(3, 2).T
    before = source.copy()
    array = _check.floats("x", source, (2, "N"))
    assert array.dtype == np.float32
    assert array.flags.c_contiguous
    np.testing.assert_array_equal(array, before)
    np.testing.assert_array_equal(source, before)
    assert _check.floats("x", 3, ()).shape == ()
    assert _check.floats("x", [[1, 2, 3]], ("N", 3)).shape == (1, 3)


@pytest.mark.parametrize(
    ("value", "message"),
    [
        (np.zeros((2, 4)), r"x: expected shape \(N, 3\), got \(2, 4\)"),
        (np.zeros(3), r"x: expected shape \(N, 3\), got \(3,\)"),
        (5.0, r"x: expected shape \(N, 3\), got \(\)"),
        ([[1, 2], [3]], r"x: expected numbers of shape \(N, 3\), got list"),
        ("abc", r"x: expected numbers of shape \(N, 3\), got str"),
        (None, r"x: expected shape \(N, 3\), got \(\)"),
        (np.zeros((1, 3), complex), r"x: expected numbers"),
        ([[10**400, 0, 0]], r"x: expected numbers"),
        ([[1, np.nan, 0]], r"x: expected finite values, got nan at index \(0, 1\)"),
        (np.array([[0, 0, 1e300]]), r"x: expected finite values, got inf at index \(0, 2\)"),
    ],
)
def test_bad_floats_are_named(value: Any, message: str) -> None:
    with pytest.raises(ValueError, match="^" + message):
        _check.floats("x", value, ("N", 3))


@given(
    hnp.arrays(
        st.sampled_from([np.float32, np.float64]),
        hnp.array_shapes(min_side=0, max_dims=3),
        elements={"allow_nan": True, "allow_infinity": True},
    )
)
def test_all_finite_is_what_it_says(array: np.ndarray) -> None:
    assert _check.all_finite(array) == bool(np.isfinite(array).all())


def test_all_finite_survives_sums_that_overflow_or_cancel() -> None:
    assert _check.all_finite(np.full(4, 1.7e308))
    assert not _check.all_finite(np.array([np.inf, -np.inf]))


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ([1.0, 2.0], "x: expected integers, got dtype float64"),
        ([True], "x: expected integers, got dtype bool"),
        ([2**70], "x: expected integers, got dtype object"),
        ([[1]], r"x: expected shape \(N,\), got \(1, 1\)"),
        (np.array([2**63], np.uint64), "x: expected values in"),
    ],
)
def test_bad_integers_are_named(value: Any, message: str) -> None:
    with pytest.raises(ValueError, match="^" + message):
        _check.integers("x", value, ("N",))


def test_integers_never_wrap_around() -> None:
    with pytest.raises(ValueError, match=r"x: expected values in \[0, 255\], got 256"):
        _check.integers("x", [0, 256], ("N",), np.uint8)
    assert _check.integers("x", [0, 255], ("N",), np.uint8).dtype == np.uint8
    assert _check.integers("x", [], ("N",)).dtype == np.int64


def test_ranges_are_closed_by_default_and_refuse_nan() -> None:
    _check.in_range("x", np.array([0.0, 1.0]), 0.0, 1.0)
    _check.in_range("x", np.array([]), 0.0, 1.0)
    with pytest.raises(ValueError, match=r"x: expected values in \(0, inf\), got 0"):
        _check.in_range("x", np.array([0.0, 1.0]), 0.0, np.inf, open_low=True)
    with pytest.raises(ValueError, match=r"x: expected values in \[0, 1\], got 2"):
        _check.in_range("x", np.array([0.0, 2.0]), 0.0, 1.0)
    with pytest.raises(ValueError, match=r"x: expected values in \[0, 1\], got nan"):
        _check.in_range("x", np.array([0.5, np.nan]), 0.0, 1.0)


def test_lengths_must_agree() -> None:
    assert _check.same_length(a=np.zeros(3), b=np.zeros((3, 2))) == 3
    with pytest.raises(ValueError, match="a / b: expected one length for all, got a 3, b 2"):
        _check.same_length(a=np.zeros(3), b=np.zeros(2))


@pytest.mark.parametrize("value", [0, -1, 1.0, True, "1", None, np.float32(1)])
def test_bad_counts_are_named(value: Any) -> None:
    with pytest.raises(ValueError, match="x: expected an integer of at least 1, got"):
        _check.positive_int("x", value)


def test_numpy_integers_count_and_choices_are_listed() -> None:
    assert type(_check.positive_int("x", np.uint8(3))) is int
    assert _check.one_of("x", "a", ("a", "b")) == "a"
    with pytest.raises(ValueError, match="x: expected one of 'a', 'b', got 'c'"):
        _check.one_of("x", "c", ("a", "b"))


@given(hnp.arrays(np.float64, (5, 3), elements=st.floats(-1e308, 1e308, allow_subnormal=False)))
def test_unit_vectors_are_unit_at_every_scale(vectors: np.ndarray) -> None:
    vectors[np.abs(vectors).max(axis=1) < 1e-300] = [1e-200, 0, 0]
    unit = _check.unit_vectors("x", vectors)
    np.testing.assert_allclose(np.linalg.norm(unit, axis=1), 1.0, atol=1e-12)
    scale = np.abs(vectors).max(axis=1, keepdims=True)
    assert (np.einsum("ij,ij->i", unit, vectors / scale) > 0.5).all()


def test_a_zero_direction_is_named() -> None:
    with pytest.raises(ValueError, match="x: expected non-zero directions, got a zero vector at index 1"):
        _check.unit_vectors("x", [[1, 0, 0], [0, 0, 0]])
    assert _check.unit_vectors("x", np.zeros((0, 3))).shape == (0, 3)


def test_tensors_are_taken_detached_and_those_that_train_are_copied() -> None:
    torch = pytest.importorskip("torch")
    frozen, trained = torch.ones(4, 3), torch.ones(4, 3, requires_grad=True)
    assert np.shares_memory(_check.floats("x", frozen, ("N", 3)), frozen.numpy())
    array = _check.floats("x", trained, ("N", 3))
    with torch.no_grad():
        trained.mul_(2.0)
    assert np.array_equal(array, np.ones((4, 3)))
    half = _check.floats("x", torch.full((2,), 0.5, dtype=torch.bfloat16), ("N",))
    assert half.dtype == np.float32
    assert half.tolist() == [0.5, 0.5]
    rows: list[Any] = [torch.zeros(3), torch.ones(3, requires_grad=True)]
    assert _check.floats("x", rows, ("N", 3)).tolist() == [[0, 0, 0], [1, 1, 1]]
    assert _check.floats("x", [[row[0] for row in rows]], (1, "N")).tolist() == [[0, 1]]
    assert _check.integers("x", [torch.tensor(3), torch.tensor(4)], ("N",)).tolist() == [3, 4]
    with pytest.raises(ValueError, match=r"x: expected shape \(N, 3\), got \(4, 2\)"):
        _check.floats("x", torch.zeros(4, 2, requires_grad=True), ("N", 3))
    with pytest.raises(ValueError, match="x: expected numbers of shape"):
        _check.floats("x", torch.zeros(4, 3).to_sparse(), ("N", 3))


@pytest.mark.parametrize(
    ("value", "shape", "remedy"),
    [
        (np.zeros((4, 1)), ("N",), "; pass x[..., 0]"),
        (np.zeros((4, 3)), ("N", 1, 3), "; pass x[:, None]"),
        (np.zeros((4, 2)), ("N", 1, 3), ""),
        (np.zeros((4, 2)), ("N",), ""),
        (np.zeros(()), ("N", 3), ""),
    ],
)
def test_an_axis_of_length_1_too_many_or_too_few_has_a_remedy(value: Any, shape: Any, remedy: str) -> None:
    with pytest.raises(ValueError, match="x: expected shape") as caught:
        _check.floats("x", value, shape)
    assert str(caught.value).endswith(f"got {value.shape}{remedy}")
    if remedy:
        assert _check.floats("x", eval(remedy.removeprefix("; pass "), {"x": value}), shape).size == value.size


def test_torch_is_not_imported_to_look_for_tensors() -> None:
    code = (
        "import sys, gsvis; gsvis.Gaussians([[0, 0, 0]], [[1, 0, 0, 0]], [[1, 1, 1]], [0.5], [[[0, 0, 0]]]);"
        "assert 'torch' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=120)


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ("anlyze", "did you mean analyze?"),
        ("CONVERT", "did you mean convert?"),
        ("convrt", "did you mean convert?"),
        ("zzz", ""),
        ("", ""),
        (3, ""),
        ("a" * 10**6, ""),
    ],
)
def test_what_looks_alike_is_suggested(value: Any, message: str) -> None:
    assert _check.suggestion(value, ("analyze", "convert")) == message
    with pytest.raises(ValueError, match=r"mode: expected one of 'analyze', 'convert', got") as caught:
        _check.one_of("mode", value, ("analyze", "convert"))
    assert str(caught.value).endswith(message)


def test_paths_are_coerced(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    assert _check.path("file", "~/a.ply") == tmp_path / "a.ply"
    assert _check.path("file", Path("~") / "a.ply") == Path("~/a.ply")
    assert _check.path("file", _check.path("file", "./~/a.ply")) == Path("~/a.ply")
    assert _check.path("file", "a~b") == Path("a~b")
    assert _check.path("file", os.fsencode("a.ply")) == Path("a.ply")  # type: ignore[arg-type]
    for value, got in ((3, "got int"), (None, "got NoneType"), ("", "got an empty text"), ("a\0", "with a NUL in it")):
        with pytest.raises(ValueError, match=f"file: expected a path, {got}|file: expected a path, got a text {got}"):
            _check.path("file", value)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("values", "rules", "found"),
    [
        ([0, 2, 2, 7], {"first": 0, "last": 7}, ""),
        ([1, 2], {"first": 0}, "1 at index 0"),
        ([0, 5, 3, 1], {}, "3 after 5 at index 2"),
        ([0, 2, 2], {"strictly": True}, "2 after 2 at index 2"),
        ([0, 2], {"last": 3}, "2 at the end"),
        ([0.5, np.nan], {}, "nan after 0.5 at index 1"),
        ([0, 1_500_000, 2], {}, "2 after 1,500,000 at index 2"),
    ],
)
def test_what_keeps_values_from_rising_is_said(values: list[float], rules: dict[str, Any], found: str) -> None:
    assert _check.not_rising(np.array(values), **rules) == found
