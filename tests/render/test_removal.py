"""Effects of removal against doing it: by the slow twin, and by drawing the scene again without each Gaussian."""

from __future__ import annotations

from collections.abc import Iterator

import numba
import numpy as np
import pytest

from gsvis.render import rasterize, removal_effects
from gsvis.render.removal import Removals
from gsvis.render.removal_reference import removal_reference
from gsvis.scene.cameras import Cameras
from gsvis.scene.gaussians import Gaussians
from tests.raycast.scenes import KINDS, scene

SIZE = {"width": 40, "height": 30}
BACKGROUND = (0.2, 0.5, 0.9)
NAMES = ("absolute", "squared", "error_change")


def views(count: int = 2) -> Cameras:
    return Cameras.orbit([0, 0, 0], 3.0, count, **SIZE)


@pytest.fixture
def two_threads() -> Iterator[None]:
    before = numba.get_num_threads()
    yield
    numba.set_num_threads(before)


def without(g: Gaussians, index: int) -> Gaussians:
    return g[np.arange(len(g)) != index]


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind != "far"])
def test_effects_equal_the_twin(kind: str) -> None:
    g, cameras = scene(kind, n=120), views()
    rng = np.random.default_rng(5)
    images = rng.uniform(0.0, 1.0, (2, 30, 40, 3)).astype(np.float32)
    residuals = rasterize(g, cameras, background=BACKGROUND).images.astype(np.float64) - images
    got = removal_effects(g, cameras, images=images, background=BACKGROUND)
    want = removal_reference(g, cameras, residuals=residuals, background=BACKGROUND)
    assert got.pixels == want.pixels == 2 * 30 * 40
    for name in NAMES:
        value, expected = getattr(got, name), getattr(want, name)
        assert value.dtype == np.float64
        np.testing.assert_allclose(value, expected, atol=1e-3, rtol=2e-4, err_msg=name)


def test_effects_equal_images_drawn_again() -> None:
    g, cameras = scene("blobs", n=40), views()
    g = Gaussians(g.means, g.quats, g.scales, 0.7 * g.opacities, g.sh0, g.shN)  # no pixel spends its light
    images = rasterize(scene("blobs", seed=3, n=40), cameras).images
    effects = removal_effects(g, cameras, images=images)
    drawn = rasterize(g, cameras).images.astype(np.float64)
    for index in range(len(g)):
        again = rasterize(without(g, index), cameras).images.astype(np.float64)
        change = np.abs(again - drawn).sum() / 3.0, np.square(again - drawn).sum() / 3.0
        np.testing.assert_allclose([effects.absolute[index], effects.squared[index]], change, atol=2e-3, rtol=2e-4)
        by_error = (np.square(again - images) - np.square(drawn - images)).sum() / 3.0
        np.testing.assert_allclose(effects.error_change[index], by_error, atol=2e-3, rtol=2e-4)


def test_what_lies_behind_an_opaque_wall_shows_when_the_wall_goes() -> None:
    """Two opaque sheets: an image stops between them, the removal of the first must know the second all the same."""
    sh0 = (np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])[:, None] - 0.5) / 0.28209479177387814
    sheets = Gaussians([[0, 0, 0.0], [0, 0, 1.0]], [[1, 0, 0, 0]] * 2, [[50.0, 50.0, 1e-3]] * 2, [1.0, 1.0], sh0)
    camera = Cameras.look_at([[0, 0, -3.0]], [[0, 0, 0]], up=[0, -1, 0], width=16, height=16)
    effects = removal_effects(sheets, camera)
    want = 0.999 * 256 * 2 / 3  # red goes, green comes
    np.testing.assert_allclose(effects.absolute, [want, want * 1e-3 / 2], rtol=3e-3)


def test_own_images_as_targets_change_nothing() -> None:
    g, cameras = scene("mixed"), views()
    images = rasterize(g, cameras, background=BACKGROUND).images
    plain = removal_effects(g, cameras, background=BACKGROUND)
    against_own = removal_effects(g, cameras, images=images, background=BACKGROUND)
    np.testing.assert_array_equal(plain.squared, plain.error_change)
    np.testing.assert_allclose(against_own.error_change, plain.squared, atol=1e-4)


def test_a_wrong_gaussian_is_better_gone() -> None:
    g, cameras = scene("blobs", n=30), views()
    largest = int(removal_effects(g, cameras).squared.argmax())
    images = rasterize(without(g, largest), cameras).images
    effects = removal_effects(g, cameras, images=images)
    assert effects.error_change.argmin() == largest
    np.testing.assert_allclose(effects.error_change[largest], -effects.squared[largest], rtol=1e-3)


def test_the_absent_are_tried() -> None:
    """A Gaussian that is absent changes nothing for the rest, and adding it does what its removal would undo."""
    g, cameras = scene("mixed", n=60), views()
    images = rasterize(scene("blobs", seed=3, n=40), cameras).images
    full = removal_effects(g, cameras, images=images)
    for index in range(0, len(g), 7):
        present = np.arange(len(g)) != index
        tried = removal_effects(g, cameras, images=images, presence=present)
        alone = removal_effects(g[present], cameras, images=images)
        for name in NAMES:
            np.testing.assert_allclose(getattr(tried, name)[present], getattr(alone, name), atol=1e-3, rtol=1e-4)
        np.testing.assert_allclose(tried.squared[index], full.squared[index], atol=1e-3, rtol=1e-3)
        change, allowed = full.error_change[index], 0.02 * full.squared[index] + 1e-2
        np.testing.assert_allclose(tried.error_change[index], change, atol=allowed)


def test_presence_thins_alpha() -> None:
    g, cameras = scene("blobs", n=50), views()
    g = Gaussians(g.means, g.quats, g.scales, 0.2 + 0.5 * g.opacities, g.sh0, g.shN)
    share = np.full(len(g), 0.5)
    thin = Gaussians(g.means, g.quats, g.scales, 0.5 * g.opacities, g.sh0, g.shN)
    got, want = removal_effects(g, cameras, presence=share), removal_effects(thin, cameras)
    np.testing.assert_allclose(got.absolute, 2.0 * want.absolute, rtol=0.1, atol=0.05 * got.absolute.max())
    with pytest.raises(ValueError, match=r"^presence: expected values in \[0, 1\], got 2"):
        removal_effects(g, cameras, presence=4.0 * share)


def test_order_threads_and_colors_change_nothing(two_threads: None) -> None:
    g, cameras = scene("mixed", n=200), views()
    plain = removal_effects(g, cameras)
    turn = np.random.default_rng(0).permutation(len(g))
    turned = removal_effects(g[turn], cameras)
    numba.set_num_threads(1)
    alone = removal_effects(g, cameras)
    flat = Gaussians(g.means, g.quats, g.scales, g.opacities, g.sh0)
    colors = np.maximum(0.5 + 0.28209479177387814 * g.sh0[:, 0], 0.0)
    given, own = removal_effects(flat, cameras, colors=colors), removal_effects(flat, cameras)
    for name in NAMES:
        np.testing.assert_array_equal(getattr(turned, name), getattr(plain, name)[turn])
        np.testing.assert_array_equal(getattr(alone, name), getattr(plain, name))
        np.testing.assert_allclose(getattr(given, name), getattr(own, name), atol=1e-4)


def test_views_add_up() -> None:
    g, cameras = scene("blobs", n=50), views(3)
    calls: list[tuple[str, int, int]] = []
    whole = removal_effects(g, cameras, progress=lambda *call: calls.append(call))
    parts = [removal_effects(g, cameras[c]) for c in range(3)]
    np.testing.assert_allclose(whole.absolute, sum(part.absolute for part in parts), rtol=1e-12)
    assert calls == [("removal", i, 3) for i in range(4)]


def test_eight_bit_targets() -> None:
    g, cameras = scene("blobs", n=50), views()
    images = np.random.default_rng(0).integers(0, 256, (2, 30, 40, 3), dtype=np.uint8)
    as_floats = removal_effects(g, cameras, images=(images / 255.0).astype(np.float32))
    np.testing.assert_allclose(removal_effects(g, cameras, images=images).error_change, as_floats.error_change)


def test_nothing_to_do() -> None:
    assert removal_effects(Gaussians.empty(), views()).squared.shape == (0,)
    assert not removal_effects(scene("one"), views()[:0]).absolute.any()
    away = Cameras.look_at([[0, 0, -9.0]], [[0, 0, -10.0]], up=[0, -1, 0], **SIZE)
    assert not removal_effects(scene("blobs"), away).absolute.any()


def test_refusals() -> None:
    g, cameras = scene("one"), views()
    with pytest.raises(ValueError, match=r"^images: expected shape \(2, 30, 40, 3\) to go with the cameras, got"):
        removal_effects(g, cameras, images=np.zeros((1, 30, 40, 3), np.uint8))
    with pytest.raises(ValueError, match=r"^images: expected uint8 or floats, got dtype int64"):
        removal_effects(g, cameras, images=np.zeros((2, 30, 40, 3), np.int64))
    with pytest.raises(ValueError, match=r"^images: expected finite values"):
        removal_effects(g, cameras, images=np.full((2, 30, 40, 3), np.nan, np.float32))
    with pytest.raises(ValueError, match=r"^background: "):
        removal_effects(g, cameras, background=(0.0, 0.0))


def test_what_is_not_shown_is_as_if_not_given() -> None:
    g = scene("blobs", n=60)
    shown = np.arange(60) % 3 > 0
    masked = removal_effects(g, views(), shown=shown)
    selected = removal_effects(g[shown], views())
    for name in NAMES:
        assert np.array_equal(getattr(masked, name)[shown], getattr(selected, name))
        assert not getattr(masked, name)[~shown].any()
    with pytest.raises(ValueError, match="shown: expected bool"):
        removal_effects(g, views(), shown=shown[:5])


def test_effects_of_some_among_others_are_those_among_all() -> None:
    g = scene("mixed", n=120)
    cameras = views()
    rng = np.random.default_rng(4)
    presence = rng.random(len(g)).astype(np.float32)
    shown = rng.random(len(g)) < 0.7
    first = len(g) // 2
    removals = Removals(g[:first], g[first:])
    sums = np.ones(first)
    expected = np.ones(first)
    for c in range(len(cameras)):
        ids, effects = removals.seen_by(cameras[c], presence, shown)
        sums[ids] += effects
        expected += removal_effects(g, cameras[c], presence=presence, shown=shown).squared[:first]
    np.testing.assert_array_equal(sums, expected)
    assert (sums > 1.0).any()
