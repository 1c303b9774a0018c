"""Add the weights of one view to those of the faces from which it sees Gaussians. World frame."""

from __future__ import annotations

import numpy as np

from gsvis._kernels.compiled import kernel, uncounted
from gsvis._kernels.faces import face_of
from gsvis._kernels.threads import in_parts

_BLOCK = 1 << 14  # Gaussians of which a thread gets whole blocks


@uncounted
def _add(first, last, places, means, largest, summed, eye, pixels, centers, planes, faces):
    """Add Gaussians first..last; see `add_squares`."""
    for i in range(first, last):
        squared = largest[i] * summed[i]
        if squared == np.float32(0.0):
            continue
        x = eye[0] - means[i, 0]
        y = eye[1] - means[i, 1]
        z = eye[2] - means[i, 2]
        if x != 0.0 or y != 0.0 or z != 0.0:
            faces[places[i], face_of(x, y, z, centers, planes)] += squared / pixels


@in_parts(lambda places, *_: (len(places) + _BLOCK - 1) // _BLOCK)
@kernel(error_model="numpy")
def add_squares(begin, end, places, means, largest, summed, eye, pixels, centers, planes, faces):
    """Add a bound of the squared weights of each Gaussian, a pixel, to the face that it is seen from.

    Args:
        begin: The first block of a thread.
        end: The end of its blocks.
        places: (n,) int64, the row of each Gaussian in `faces`; all different.
        means: (n, 3) float32.
        largest: (n,) float32, largest weight of each in the view.
        summed: (n,) float32, its weights in the view, summed.
        eye: (3,) float64.
        pixels: float32, by which sums are divided.
        centers: (80, 3), of the faces; see `face_planes`.
        planes: Their planes.
        faces: (N, 80) float32, to which is added.
    """
    _add(
        _BLOCK * begin,
        min(_BLOCK * end, len(places)),
        places,
        means,
        largest,
        summed,
        eye,
        pixels,
        centers,
        planes,
        faces,
    )
