"""Compute the training loss and its gradient by the image: |difference| and SSIM, in two passes over rows.

Images are (H, 3 W) float32, channels interleaved, so that a step to the next pixel is three values. Windows extend over
black surroundings ("same" padding). Sums are taken by bands of rows and do not depend on the number of threads.
"""

from __future__ import annotations

import numpy as np

from gsvis._kernels.compiled import kernel, njit
from gsvis._kernels.threads import in_parts

ROWS = 16  # rows of one task
_C1 = np.float32(0.01**2)
_C2 = np.float32(0.03**2)


@njit(cache=True, nogil=True, fastmath={"contract"}, error_model="numpy", inline="always")
def _across(row, window, reach, out):
    """Blur a row that has `reach` zeros on either side, with a stride of three values."""
    out[:] = 0
    for k in range(len(window)):
        weight = window[k]
        for x in range(len(out)):
            out[x] += weight * row[x + 3 * k]


@in_parts(lambda *arguments: len(arguments[-1]))
@kernel(fastmath={"contract"}, error_model="numpy")
def compare(begin, end, image, target, window, slopes, sums):
    """Compute SSIM of every value: its sums, and its derivatives by the moments.

    slopes: (3, H, 3 W), written: derivatives of SSIM by the windows' mean of the image, of its square and of the
        product.
    sums: (bands, 2), written: sums of |image - target| and of SSIM.
    """
    height, width = image.shape
    taps = len(window)
    margin = taps // 2
    one = np.float32(1.0)
    two = np.float32(2.0)
    reach = 3 * margin
    for band in range(begin, end):
        rows = np.zeros((5, width + 2 * reach), np.float32)
        means = np.empty((5, width), np.float32)
        difference = 0.0
        likeness = 0.0
        for y in range(band * ROWS, min((band + 1) * ROWS, height)):
            inner = rows[:, reach : reach + width]
            inner[:] = 0
            for k in range(max(0, margin - y), min(taps, height + margin - y)):
                weight = window[k]
                a = image[y + k - margin]
                b = target[y + k - margin]
                for x in range(width):
                    wa = weight * a[x]
                    wb = weight * b[x]
                    inner[0, x] += wa
                    inner[1, x] += wb
                    inner[2, x] += wa * a[x]
                    inner[3, x] += wb * b[x]
                    inner[4, x] += wa * b[x]
            for e in range(5):
                _across(rows[e], window, reach, means[e])
            line = image[y]
            other = target[y]
            away = np.float32(0.0)
            alike = np.float32(0.0)
            for x in range(width):
                mx = means[0, x]
                my = means[1, x]
                a1 = two * mx * my + _C1
                a2 = two * (means[4, x] - mx * my) + _C2
                b1 = mx * mx + my * my + _C1
                b2 = (means[2, x] - mx * mx) + (means[3, x] - my * my) + _C2
                whole = one / (b1 * b2)
                s = a1 * a2 * whole
                slopes[0, y, x] = two * (my * (a2 - a1) * whole - s * mx * (one / b1 - one / b2))
                slopes[1, y, x] = -s / b2
                slopes[2, y, x] = two * a1 * whole
                alike += s
                away += abs(line[x] - other[x])
            difference += away
            likeness += alike
        sums[band, 0] = difference
        sums[band, 1] = likeness


@in_parts(lambda image, *_: (len(image) + ROWS - 1) // ROWS)
@kernel(fastmath={"contract"}, error_model="numpy")
def slope(begin, end, image, target, window, slopes, by_difference, by_likeness, out):
    """Write the gradient (H, 3 W) of by_difference * sum |image - target| + by_likeness * sum of SSIM into out."""
    height, width = image.shape
    taps = len(window)
    margin = taps // 2
    two = np.float32(2.0)
    by_difference = np.float32(by_difference)
    by_likeness = np.float32(by_likeness)
    reach = 3 * margin
    for band in range(begin, end):
        rows = np.zeros((3, width + 2 * reach), np.float32)
        blurred = np.empty((3, width), np.float32)
        for y in range(band * ROWS, min((band + 1) * ROWS, height)):
            inner = rows[:, reach : reach + width]
            inner[:] = 0
            for k in range(max(0, margin - y), min(taps, height + margin - y)):
                weight = window[k]
                for e in range(3):
                    source = slopes[e, y + k - margin]
                    into = inner[e]
                    for x in range(width):
                        into[x] += weight * source[x]
            for e in range(3):
                _across(rows[e], window, reach, blurred[e])
            line = image[y]
            other = target[y]
            for x in range(width):
                likeness = blurred[0, x] + two * line[x] * blurred[1, x] + other[x] * blurred[2, x]
                out[y, x] = by_difference * np.sign(line[x] - other[x]) + by_likeness * likeness
