"""What a record of training is in JSON: numbers that JSON can hold, and nothing that differs from run to run."""

from __future__ import annotations

import json
import math

import pytest

from gsvis.train.history import Record


@pytest.mark.parametrize(("psnr", "expected"), [(31.5, 31.5), (math.inf, 100.0), (math.nan, None)])
def test_a_record_is_json_without_its_time(psnr: float, expected: float | None) -> None:
    point = Record(step=3, seconds=1.5, loss=0.25, count=7, psnr=psnr).as_json()
    assert point == {"step": 3, "loss": 0.25, "count": 7, "psnr": expected}
    json.dumps(point, allow_nan=False)


@pytest.mark.parametrize("loss", [math.nan, math.inf])
def test_a_loss_that_is_no_number_is_none(loss: float) -> None:
    assert Record(step=0, seconds=0.0, loss=loss, count=1).as_json()["loss"] is None
