"""LPIPS: its laws with weights that are drawn, and files that are no weights."""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np
import pytest
import torch
from paper.perceptual import Lpips, open_lpips

from gsvis.errors import FormatError


def small() -> Lpips:
    """Return the distance with two channels in each layer."""
    generator = torch.Generator().manual_seed(0)
    counts = [3, *[2] * 13]
    layers = [
        (torch.randn(2, counts[k], 3, 3, generator=generator), torch.randn(2, generator=generator)) for k in range(13)
    ]
    return Lpips(layers, [torch.ones(1, 2, 1, 1)] * 5)


def test_equal_images_have_no_distance_and_others_are_alike_both_ways() -> None:
    rng = np.random.default_rng(0)
    one, other = (rng.random((32, 40, 3)).astype(np.float32) for _ in range(2))
    distance = small()
    assert distance(one, one) == 0.0
    assert distance(one, other) > 0.0
    assert distance(one, other) == pytest.approx(distance(other, one))


@pytest.mark.parametrize("data", [b"", b"no weights", pickle.dumps({"VGG16_0": {}}), pickle.dumps(Path("a"))])
def test_a_file_that_holds_no_weights_is_refused_in_one_line(tmp_path: Path, data: bytes) -> None:
    file = tmp_path / "vgg16.ckpt"
    file.write_bytes(data)
    with pytest.raises(FormatError, match=r"expected the weights of LPIPS on VGG-16") as refused:
        Lpips.read(file)
    assert "\n" not in str(refused.value)


def test_arrays_are_read_as_numpy_wrote_them(tmp_path: Path) -> None:
    file = tmp_path / "vgg16.ckpt"
    layer = {"kernel": np.zeros((3, 3, 1, 1), np.float32), "bias": np.zeros(1, np.float32)}
    last = {"Conv_0": {"kernel": np.zeros((1, 1, 1, 1), np.float32)}}
    network = {f"Conv_{k}": layer for k in range(13)}
    file.write_bytes(pickle.dumps({"VGG16_0": network, **{f"NetLinLayer_{k}": last for k in range(5)}}, protocol=4))
    with pytest.raises(FormatError, match=r"expected layers of \(64, 128"):
        Lpips.read(file)


def test_weights_that_are_not_installed_are_no_error() -> None:
    found = open_lpips()
    assert found is None or found(np.zeros((32, 32, 3)), np.zeros((32, 32, 3))) == 0.0
