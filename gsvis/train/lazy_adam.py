"""Adam for arrays of which a step uses few rows: a row takes the steps that it missed when it is used again.

Between two gradients of a row its moments only fade, so that the sum of its steps is known in closed form. The result
is that of plain Adam without a floor under the root (eps), to rounding.

References:
    Kingma and Ba, "Adam: a method for stochastic optimization", ICLR 2015, algorithm 1.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from gsvis.files.scratch import Scratch
from gsvis.train._kernels.adam import catch_up_rows, step_rows

__all__ = ["LazyAdam"]

F32 = NDArray[np.float32]
I64 = NDArray[np.int64]

_BETA1 = 0.9
_BETA2 = 0.999
_BLOCK = 1 << 20  # rows that are brought up to date at a time


class LazyAdam:
    """Take steps of Adam with rows of arrays.

    Args:
        values: (R, K) float32 arrays by name, C-contiguous, all of R rows; changed in place.
        rates: Learning rate of each array at the first step.
        fall: Factor on all rates after each step.
        steps: Maximum number of steps.
        scratch: Makes the arrays of moments; None keeps them in memory.

    Attributes:
        values: The arrays. Rows that missed steps are not up to date until `catch_up` or `finish`.
        step_count: Steps taken.
    """

    def __init__(
        self,
        values: Mapping[str, F32],
        rates: Mapping[str, float],
        fall: float,
        steps: int,
        scratch: Scratch | None = None,
    ) -> None:
        place = scratch or Scratch()
        self.values = dict(values)
        self.step_count = 0
        self._rates = dict(rates)
        self._fall = fall
        self._first = {name: place.zeros(each.shape) for name, each in self.values.items()}
        self._second = {name: place.zeros(each.shape) for name, each in self.values.items()}
        self._last = place.zeros((len(next(iter(self.values.values()))),), np.int32)
        self._scratch = place
        times = np.arange(steps + 1)
        self._fade1 = _BETA1**times
        self._fade2 = _BETA2**times
        self._moved = np.zeros(steps + 1)  # for a rate of 1, by the last step of a row

    def read(self, rows: I64) -> dict[str, F32]:
        """Return the values (M, K) of some different rows (M,) by name, up to date."""
        self.catch_up(rows)
        return {name: each[rows] for name, each in self.values.items()}

    def step(self, rows: I64, gradients: Mapping[str, F32]) -> None:
        """Take one step. The gradients of rows that are not named are 0.

        Args:
            rows: (M,) different rows, up to date.
            gradients: (M, K) by name.
        """
        self.step_count += 1
        now = self.step_count
        root = math.sqrt(1.0 - _BETA2**now)
        correction = 1.0 - _BETA1**now
        rate = self._fall ** (now - 1)
        for name, each in self.values.items():
            step_rows(
                rows,
                each,
                np.ascontiguousarray(gradients[name], np.float32),
                self._first[name],
                self._second[name],
                self._rates[name] * rate / correction,
                _BETA1,
                _BETA2,
                root,
            )
        since = np.arange(1, now)
        self._moved[1:now] += rate * root / correction * (_BETA1 / math.sqrt(_BETA2)) ** (now - since)
        self._last[rows] = now

    def finish(self) -> None:
        """Bring all rows up to date; no step follows."""
        for start in range(0, len(self._last), _BLOCK):
            self.catch_up(np.arange(start, min(start + _BLOCK, len(self._last))))
            self._scratch.release()
        self._first.clear()
        self._second.clear()

    def catch_up(self, rows: I64) -> None:
        """Take the missed steps of some different rows (M,)."""
        now = self.step_count
        for name, each in self.values.items():
            catch_up_rows(
                rows,
                each,
                self._first[name],
                self._second[name],
                self._last,
                now,
                self._rates[name] * self._moved,
                self._fade1,
                self._fade2,
            )
        used = rows[self._last[rows] > 0]
        self._last[used] = now
