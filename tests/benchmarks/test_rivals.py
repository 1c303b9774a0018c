"""What levels are compared with: the octree's laws, the heaviest, images with fewer pixels."""

from __future__ import annotations

import numpy as np

from benchmarks._rivals import downsampled_images, heaviest, merged_densities
from gsvis.scene.gaussians import Gaussians


def cloud(n: int = 600, seed: int = 3, degree: int = 1) -> Gaussians:
    rng = np.random.default_rng(seed)
    return Gaussians(
        rng.normal(size=(n, 3)) * [3.0, 2.0, 1.0],
        rng.normal(size=(n, 4)),
        np.exp(rng.normal(-3.0, 0.7, size=(n, 3))),
        rng.uniform(0.05, 0.9, size=n),
        rng.normal(size=(n, 1, 3)),
        0.1 * rng.normal(size=(n, (degree + 1) ** 2 - 1, 3)),
    )


def test_the_heaviest_keep_their_order() -> None:
    g = cloud(5)
    np.testing.assert_array_equal(heaviest(g, [1, 3, 2, 3, 0], 3).means, g.means[[1, 2, 3]])
    assert len(merged_densities(g, heaviest(g, [1, 3, 2, 3, 0], 3))) == 8


def test_images_with_fewer_pixels() -> None:
    rng = np.random.default_rng(1)
    images = rng.random((2, 24, 32, 3), np.float32)
    np.testing.assert_allclose(downsampled_images(images, 1.0), images, atol=1e-6)
    flat = np.full((1, 24, 32, 3), 0.3, np.float32)
    np.testing.assert_allclose(downsampled_images(flat, 0.2), flat, atol=1e-6)
    errors = [np.square(downsampled_images(images, share) - images).mean() for share in (0.1, 0.4, 0.8)]
    assert errors == sorted(errors, reverse=True)
