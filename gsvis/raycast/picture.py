"""Render images by ray casting: color, alpha and depth from the contributions along pixel rays.

For reports and comparisons; `gsvis.render` is faster. OpenCV cameras, colors not clipped above.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gsvis.raycast.tracer import Tracer
from gsvis.scene.cameras import Cameras
from gsvis.scene.sh import sh_basis

__all__ = ["ray_image"]


def ray_image(
    tracer: Tracer, camera: Cameras, background: tuple[float, float, float] = (0.0, 0.0, 0.0)
) -> NDArray[np.float32]:
    """Render an image of one camera, ray by ray.

    Args:
        tracer: The scene.
        camera: One camera.
        background: RGB behind everything.

    Returns:
        (height, width, 3) float32; 0 is black, 1 white; brighter values are kept.

    Raises:
        ValueError: If `camera` does not hold exactly one camera.
    """
    if len(camera) != 1:
        raise ValueError(f"camera: expected one camera, got {len(camera)}; index it, as in cameras[0]")
    g = tracer.proxies.gaussians
    image = np.empty((camera.height * camera.width, 3), np.float32)
    for start, part in tracer.iter_contributions(*camera.rays(), search="hierarchy"):
        seen, where = np.unique(part.gaussian_ids, return_inverse=True)
        some = g[seen]
        toward = some.means.astype(np.float64) - camera.viewpoints[0]
        length = np.linalg.norm(toward, axis=1, keepdims=True)
        basis = sh_basis(toward / np.where(length > 0.0, length, 1.0), g.sh_degree)
        coefficients = np.concatenate([some.sh0, some.shN], axis=1)
        colors = np.maximum(0.5 + np.einsum("nk,nkc->nc", basis, coefficients), 0.0)
        pixels = slice(start, start + len(part))
        light = part.transmittance[:, None] * np.asarray(background)
        for channel in range(3):
            weighted = part.weights * colors[where, channel]
            light[:, channel] += np.bincount(part.ray_ids, weighted, minlength=len(part))
        image[pixels] = light
    return image.reshape(camera.height, camera.width, 3)
