"""Terms that no eye needs: active only where nobody sees their Gaussian."""

from __future__ import annotations

import numpy as np

from gsvis.color.activation import Activation
from gsvis.color.srbf import SrbfColors, spherical_coordinates
from gsvis.prepare.seen_terms import drop_unseen_terms, seen_terms
from gsvis.raycast.directions import NUM_FACES, face_of, icosphere_faces

EPSILON = 0.02


def colors_of(toward: np.ndarray, decays: np.ndarray, strengths: np.ndarray, counts: list[int]) -> SrbfColors:
    """Gaussians whose terms are brightest for eyes in these directions (T, 3)."""
    count = len(toward)
    return SrbfColors(
        "rgb",
        np.full((len(counts), 3), 0.5),
        np.ones(len(counts)),
        np.concatenate([[0], np.cumsum(counts)]),
        np.zeros(count, np.uint8),
        spherical_coordinates(-toward),
        decays,
        np.repeat(strengths[:, None], 3, axis=1),
    )


def set_of(faces: np.ndarray) -> np.ndarray:
    """One direction set (1, 10) of some faces."""
    bits = np.zeros(NUM_FACES, np.uint8)
    bits[faces] = 1
    return np.packbits(bits, bitorder="little")[None]


def test_a_term_toward_where_nobody_looks_is_dropped() -> None:
    up, down = np.array([[0.1, 0.2, 1.0], [0.1, 0.2, -1.0]]) / np.sqrt(1.05)
    toward = np.stack([up, down, up])
    colors = colors_of(toward, np.array([20.0, 20.0, 20.0]), np.array([0.3, 0.3, 0.01]), [3])
    seen = set_of(face_of(up[None]))
    assert seen_terms(colors, seen, EPSILON).tolist() == [True, False, False]  # the last is too faint everywhere
    kept = drop_unseen_terms(colors, seen)
    assert kept.num_terms == 1
    np.testing.assert_array_equal(kept.centers, colors.centers[:1])
    assert seen_terms(colors, np.zeros((1, 10), np.uint8), EPSILON).sum() == 0
    assert seen_terms(colors, np.full((1, 10), 255, np.uint8), EPSILON).tolist() == [True, True, False]


def test_a_wide_term_is_kept_if_its_rim_is_seen() -> None:
    toward = np.array([[0.0, 0.0, 1.0]])
    aside = np.array([[1.0, 0.0, 0.2]])
    seen = set_of(face_of(aside))
    for decay, wanted in ((0.5, True), (30.0, False)):
        assert seen_terms(colors_of(toward, np.array([decay]), np.array([0.5]), [1]), seen, EPSILON)[0] == wanted


def test_it_agrees_with_every_direction_of_the_faces() -> None:
    rng = np.random.default_rng(0)
    count = 300
    toward = rng.normal(size=(count, 3))
    toward /= np.linalg.norm(toward, axis=1, keepdims=True)
    colors = colors_of(toward, np.exp(rng.uniform(0.0, 4.0, count)), rng.uniform(0.01, 0.5, count), [3] * 100)
    sets = np.packbits(rng.random((100, NUM_FACES)) < 0.1, axis=1, bitorder="little")
    inside = np.unpackbits(sets, axis=1, bitorder="little").astype(bool)
    parts = rng.dirichlet(np.ones(3), 200)
    places = np.einsum("pc,fcd->fpd", parts, icosphere_faces())
    most = np.zeros(count)
    activation = Activation(colors, np.zeros((100, 3)), 0.0)
    for face in range(NUM_FACES):
        of_face = np.max([activation.contributions(1e3 * place) for place in places[face]], axis=0)
        most = np.where(inside[colors.gaussian_ids, face], np.maximum(most, of_face), most)
    found = seen_terms(colors, sets, EPSILON)
    assert 50 < found.sum() < 250
    assert not (most[~found] > 1.1 * EPSILON).any()  # between the points of a face
    assert (most[found] > 0.8 * EPSILON).all()  # between the places drawn here
