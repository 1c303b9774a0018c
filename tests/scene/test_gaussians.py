"""Gaussians: what is refused, what stays untouched, and how a scene moves as one rigid body."""

from __future__ import annotations

from dataclasses import FrozenInstanceError
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gsvis.scene.gaussians import Gaussians, quats_from_rotations, rotations_from_quats
from gsvis.scene.sh import sh_basis

FIELDS = ("means", "quats", "scales", "opacities", "sh0", "shN")


def arrays(n: int = 6, degree: int = 3, seed: int = 0) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    quats = rng.normal(size=(n, 4))
    return {
        "means": rng.normal(size=(n, 3)).astype(np.float32),
        "quats": (quats / np.linalg.norm(quats, axis=1, keepdims=True)).astype(np.float32),
        "scales": rng.lognormal(size=(n, 3)).astype(np.float32),
        "opacities": rng.uniform(size=n).astype(np.float32),
        "sh0": rng.normal(size=(n, 1, 3)).astype(np.float32),
        "shN": rng.normal(size=(n, (degree + 1) ** 2 - 1, 3)).astype(np.float32),
    }


def motion(seed: int) -> tuple[np.ndarray, np.ndarray, float]:
    rng = np.random.default_rng(seed)
    quat = rng.normal(size=(1, 4))
    return rotations_from_quats(quat / np.linalg.norm(quat))[0], rng.normal(size=3), float(rng.uniform(0.1, 10))


def assert_same(a: Gaussians, b: Gaussians, atol: float = 0.0) -> None:
    for name in FIELDS:
        if name != "quats":
            np.testing.assert_allclose(getattr(a, name), getattr(b, name), rtol=atol, atol=atol, err_msg=name)
    sign = np.sign(np.sum(a.quats * b.quats, axis=1, keepdims=True))
    np.testing.assert_allclose(a.quats, sign * b.quats, atol=atol)


def test_values_are_kept_and_read_only_while_the_callers_arrays_stay_their_own() -> None:
    given_ = arrays()
    before = {name: array.copy() for name, array in given_.items()}
    scene = Gaussians(**given_)
    assert len(scene) == 6
    assert scene.sh_degree == 3
    assert scene.nbytes == sum(array.nbytes for array in given_.values())
    assert repr(scene) == "Gaussians(6 of SH degree 3)"
    for name in FIELDS:
        with pytest.raises(ValueError, match="read-only"):
            getattr(scene, name)[0] = 0
        assert given_[name].flags.writeable
        np.testing.assert_array_equal(given_[name], before[name])
        np.testing.assert_allclose(getattr(scene, name), before[name], rtol=1e-6)
    with pytest.raises(FrozenInstanceError):
        scene.means = given_["means"]  # type: ignore[misc]


def test_read_only_and_float64_input_is_taken() -> None:
    given_ = {name: array.astype(np.float64) for name, array in arrays().items()}
    for array in given_.values():
        array.flags.writeable = False
    scene = Gaussians(**given_)
    assert all(getattr(scene, name).dtype == np.float32 for name in FIELDS)


def test_without_harmonics_shares_all_other_arrays() -> None:
    g = Gaussians(**arrays(20, degree=2))
    bare = g.without_harmonics()
    assert (bare.sh_degree, g.sh_degree) == (0, 2)
    assert all(np.shares_memory(getattr(bare, name), getattr(g, name)) for name in ("means", "quats", "sh0"))
    assert bare[:3].shN.shape == (3, 0, 3)


def test_showing_some_shares_all_other_arrays() -> None:
    g = Gaussians(**arrays(20, degree=2))
    some = np.arange(20) % 3 == 0
    shown = g.showing(some)
    assert all(np.shares_memory(getattr(shown, name), getattr(g, name)) for name in FIELDS if name != "opacities")
    np.testing.assert_array_equal(shown.opacities, np.where(some, g.opacities, 0.0))
    assert not shown.opacities.flags.writeable
    with pytest.raises(ValueError, match=r"shown: expected shape \(20,\), got \(3,\)"):
        g.showing(some[:3])


def test_quaternions_of_any_length_are_normalized() -> None:
    given_ = arrays()
    reference = Gaussians(**given_)
    given_["quats"] = given_["quats"] * np.array([1e-6, 1e-3, 1, 10, 1e6, 1e18], np.float32)[:, None]
    scene = Gaussians(**given_)
    np.testing.assert_allclose(np.linalg.norm(scene.quats, axis=1), 1, rtol=1e-6)
    np.testing.assert_allclose(scene.covars(), reference.covars(), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("means", np.zeros((6, 2)), r"means: expected shape \(N, 3\)"),
        ("means", np.full((6, 3), np.nan), "means: expected finite values, got nan at index"),
        ("means", np.zeros((5, 3)), "means / quats / .*: expected one length for all, got means 5, quats 6"),
        ("quats", np.zeros((6, 4)), "quats: expected non-zero quaternions, got a zero one at index 0"),
        ("quats", np.full((6, 4), np.inf), "quats: expected finite"),
        ("scales", np.zeros((6, 3)), r"scales: expected values in \(0, inf\), got 0"),
        ("scales", -np.ones((6, 3)), "scales: expected values in .*, got -1"),
        ("opacities", np.full(6, 1.5), r"opacities: expected values in \[0, 1\], got 1.5"),
        ("opacities", np.full((6, 1), 0.5), r"opacities: expected shape \(N,\)"),
        ("sh0", np.zeros((6, 3)), r"sh0: expected shape \(N, 1, 3\), got \(6, 3\)"),
        ("shN", np.zeros((6, 5, 3)), "expected 1, 4, 9 or 16 coefficients together, got 6"),
        ("shN", "junk", "shN: expected numbers"),
    ],
)
def test_a_bad_argument_names_itself(name: str, value: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Gaussians(**{**arrays(), name: value})


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_an_empty_scene_is_a_scene(degree: int) -> None:
    scene = Gaussians.empty(degree)
    assert (len(scene), scene.sh_degree) == (0, degree)
    assert scene.covars().shape == (0, 3, 3)
    assert len(scene.transform(np.eye(3))) == 0
    assert len(scene[:]) == 0
    with pytest.raises(ValueError, match="got an empty scene"):
        scene.bounds()


def test_indexing_selects_and_permutes_every_array_alike() -> None:
    scene = Gaussians(**arrays())
    order = np.array([3, 1, 5, 0, 4, 2])
    for index in (slice(1, 4), slice(None, None, -2), order, [0, 0], scene.opacities > 0.5, 2, -1, np.int64(3)):
        picked = scene[index]
        where = np.atleast_1d(np.arange(6)[index])
        assert len(picked) == len(where)
        for name in FIELDS:
            np.testing.assert_array_equal(getattr(picked, name), getattr(scene, name)[where])
            assert not getattr(picked, name).flags.writeable
            assert getattr(picked, name).flags.c_contiguous
    assert_same(scene[order][np.argsort(order)], scene)
    for bad in (6, -7, np.zeros((2, 2), int), (0, 1), (slice(None), 0), np.zeros(5, bool)):
        with pytest.raises(IndexError):
            scene[bad]


def test_concatenation_pads_lower_degrees_and_undoes_splitting() -> None:
    scene = Gaussians(**arrays())
    assert_same(Gaussians.concatenate([scene[:2], scene[2:2], scene[2:]]), scene)
    mixed = Gaussians.concatenate([scene, Gaussians(**arrays(2, degree=1))])
    assert (len(mixed), mixed.sh_degree) == (8, 3)
    assert not mixed.shN[6:, 3:].any()
    with pytest.raises(ValueError, match="parts: expected at least one"):
        Gaussians.concatenate([])


def test_bounds_ignore_floaters_but_hold_the_scene() -> None:
    given_ = arrays(1000)
    given_["means"] = np.random.default_rng(0).uniform(-1, 1, (1000, 3)).astype(np.float32)
    calm = Gaussians(**given_).bounds()
    given_["means"][::200] = 2e4
    wild = Gaussians(**given_)
    np.testing.assert_allclose(wild.bounds(), calm, atol=0.05)
    np.testing.assert_allclose(wild.bounds(), [[-1] * 3, [1] * 3], atol=0.05)
    np.testing.assert_allclose(wild.bounds(1.0)[1], 2e4)
    inner, outer = wild.bounds(0.5), wild.bounds(0.9)
    assert (outer[0] <= inner[0]).all()
    assert (inner[1] <= outer[1]).all()
    for bad in (0.0, 1.1, np.nan):
        with pytest.raises(ValueError, match="coverage"):
            wild.bounds(bad)


@given(seed=st.integers(0, 10**6))
def test_quaternions_and_rotations_are_two_spellings(seed: int) -> None:
    quats = np.random.default_rng(seed).normal(size=(8, 4))
    quats[:4] = np.round(quats[:4])  # half turns and other ties
    quats[np.linalg.norm(quats, axis=1) == 0] = [1, 0, 0, 0]
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    rotations = rotations_from_quats(quats)
    np.testing.assert_allclose(rotations @ np.swapaxes(rotations, 1, 2), [np.eye(3)] * 8, atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(rotations), 1)
    back = quats_from_rotations(rotations)
    assert (back[:, 0] >= 0).all()
    np.testing.assert_allclose(rotations_from_quats(back), rotations, atol=1e-12)


def test_a_known_quaternion_turns_the_known_way() -> None:
    quarter = np.sqrt(0.5)
    np.testing.assert_allclose(
        rotations_from_quats(np.array([[quarter, 0, 0, quarter]]))[0], [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-15
    )


@given(seed=st.integers(0, 10**6))
def test_motions_compose_and_undo(seed: int) -> None:
    scene = Gaussians(**arrays(seed=seed))
    (ra, ta, sa), (rb, tb, sb) = motion(seed + 1), motion(seed + 2)
    twice = scene.transform(ra, ta, sa).transform(rb, tb, sb)
    assert_same(twice, scene.transform(rb @ ra, sb * (rb @ ta) + tb, sb * sa), atol=1e-4)
    assert_same(scene.transform(ra, ta, sa).transform(ra.T, -ra.T @ ta / sa, 1 / sa), scene, atol=1e-4)


@given(seed=st.integers(0, 10**6))
def test_covariances_and_colors_move_with_the_scene(seed: int) -> None:
    scene = Gaussians(**arrays(seed=seed))
    r, t, s = motion(seed)
    moved = scene.transform(r, t, s)
    np.testing.assert_allclose(moved.covars(), s * s * r @ scene.covars() @ r.T, rtol=1e-3, atol=1e-4 * s * s)
    np.testing.assert_allclose(moved.means, s * scene.means @ r.T + t, rtol=1e-4, atol=1e-4)
    eye = np.array([0.3, -4.0, 2.0])
    np.testing.assert_allclose(colors(moved, s * r @ eye + t), colors(scene, eye), atol=1e-4)


def colors(scene: Gaussians, eye: np.ndarray) -> np.ndarray:
    d = scene.means - eye
    basis = sh_basis(d / np.linalg.norm(d, axis=1, keepdims=True), scene.sh_degree)
    return 0.5 + np.einsum("nk,nkc->nc", basis, np.concatenate([scene.sh0, scene.shN], axis=1))


def test_moving_commutes_with_selecting() -> None:
    scene = Gaussians(**arrays())
    r, t, s = motion(0)
    order = np.array([5, 0, 3])
    assert_same(scene[order].transform(r, t, s), scene.transform(r, t, s)[order], atol=1e-6)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"rotation": 2 * np.eye(3)}, "rotation: expected an orthonormal"),
        ({"rotation": np.diag([1.0, 1.0, -1.0])}, "rotation: expected an orthonormal"),
        ({"rotation": np.eye(4)}, r"rotation: expected shape \(3, 3\)"),
        ({"translation": [0, 0]}, r"translation: expected shape \(3,\)"),
        ({"scale": 0.0}, "scale: expected a finite number > 0"),
        ({"scale": np.nan}, "scale: expected a finite number > 0"),
    ],
)
def test_a_bad_motion_names_itself(change: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Gaussians(**arrays()).transform(**{"rotation": np.eye(3), **change})


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("scales", np.log, "did you pass log scales? pass np.exp(log_scales), or use gsvis.from_gsplat"),
        ("opacities", lambda p: np.log(p / (1 - p)), "did you pass logits? pass 1 / (1 + np.exp(-logit_opacities))"),
        ("scales", np.zeros_like, "give a flat Gaussian a small positive scale"),
        ("quats", np.zeros_like, "got a zero one at index 0; pass (1, 0, 0, 0) for no rotation"),
    ],
)
def test_raw_values_get_the_remedy(name: str, change: Any, message: str) -> None:
    given_ = arrays()
    given_["opacities"] = np.linspace(0.2, 0.9, len(given_["means"]), dtype=np.float32)
    with pytest.raises(ValueError, match=f"^{name}: expected") as caught:
        Gaussians(**{**given_, name: change(given_[name])})
    assert message in str(caught.value)


def test_tensors_that_train_make_a_scene_that_stays_as_it_is() -> None:
    torch = pytest.importorskip("torch")
    expected = Gaussians(**arrays())
    tensors = {name: torch.tensor(array, requires_grad=True) for name, array in arrays().items()}
    scene = Gaussians(**tensors)
    with torch.no_grad():
        for tensor in tensors.values():
            tensor.add_(1.0)
    assert_same(scene, expected, atol=0.0)
