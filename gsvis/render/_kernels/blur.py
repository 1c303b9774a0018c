"""Blur planes of an image with a separable window; SSIM spends most of its time here.

On a CPU, torch's convolution of single-channel planes is several times slower, and its backward pass even more so.
"""

from __future__ import annotations

import numpy as np

from gsvis._kernels.compiled import kernel
from gsvis._kernels.threads import in_parts

_ROWS = 32  # rows of one task


@in_parts(lambda planes, window, margin, out: len(planes) * ((out.shape[1] + _ROWS - 1) // _ROWS))
@kernel(fastmath={"contract"}, error_model="numpy")
def blur(begin, end, planes, window, margin, out):
    """Correlate (B, H, W) planes, with `margin` rows and columns of zeros around each, with window x window.

    Only whole windows count: `out` is (B, H + 2 margin - len(window) + 1, W + 2 margin - len(window) + 1).
    """
    height, width = planes.shape[1:]
    taps = len(window)
    out_height = out.shape[1]
    out_width = out.shape[2]
    bands = (out_height + _ROWS - 1) // _ROWS
    for task in range(begin, end):
        plane = task // bands
        band = task % bands
        row = np.zeros(width + 2 * margin, planes.dtype)
        inner = row[margin : margin + width]
        for y in range(band * _ROWS, min((band + 1) * _ROWS, out_height)):
            inner[:] = 0
            for k in range(taps):
                source = y + k - margin
                if 0 <= source < height:
                    weight = window[k]
                    line = planes[plane, source]
                    for x in range(width):
                        inner[x] += weight * line[x]
            target = out[plane, y]
            target[:] = 0
            for k in range(taps):
                weight = window[k]
                for x in range(out_width):
                    target[x] += weight * row[x + k]
