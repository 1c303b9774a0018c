"""The training loss: its kernels against the sum of its parts, its gradient against theirs, and known answers."""

from __future__ import annotations

import pytest
import torch

from gsvis.train.loss import loss_reference, photometric_loss


@pytest.mark.parametrize("size", [(40, 37), (11, 5), (3, 3), (1, 50), (17, 1)])
@pytest.mark.parametrize("weight", [0.0, 0.2, 1.0])
def test_kernels_agree_with_the_parts(size: tuple[int, int], weight: float) -> None:
    generator = torch.Generator().manual_seed(size[0])
    image = torch.rand((*size, 3), generator=generator).mul(1.5).requires_grad_()
    target = torch.rand((*size, 3), generator=generator)
    fast, slow = photometric_loss(image, target, weight), loss_reference(image, target, weight)
    assert fast.item() == pytest.approx(slow.item(), abs=1e-6)
    (by_fast,), (by_slow,) = torch.autograd.grad(3.0 * fast, image), torch.autograd.grad(3.0 * slow, image)
    assert torch.allclose(by_fast, by_slow, atol=2e-6 * max(float(by_slow.abs().max()), 1e-3), rtol=1e-4)


def test_flat_images_agree() -> None:
    image, target = torch.full((20, 20, 3), 0.25, requires_grad=True), torch.full((20, 20, 3), 0.25)
    loss = photometric_loss(image, target)
    assert loss.item() == pytest.approx(0.0, abs=1e-6)
    (slope,) = torch.autograd.grad(loss, image)
    assert float(slope.abs().max()) < 1e-6


def test_without_ssim_it_is_the_mean_difference() -> None:
    image, target = torch.full((4, 6, 3), 0.75), torch.full((4, 6, 3), 0.5)
    assert photometric_loss(image, target, 0.0).item() == pytest.approx(0.25)


def test_double_precision_goes_by_the_parts_and_passes_a_check_by_finite_differences() -> None:
    generator = torch.Generator().manual_seed(1)
    image, target = (torch.rand((12, 12, 3), generator=generator, dtype=torch.float64) for _ in range(2))
    assert torch.autograd.gradcheck(lambda x: photometric_loss(x, target, 1.0), image.requires_grad_(), atol=1e-6)


def test_another_shape_is_refused() -> None:
    with pytest.raises(ValueError, match=r"target: expected the shape \(H, W, 3\) of image, \(4, 4, 3\), got"):
        photometric_loss(torch.zeros(4, 4, 3), torch.zeros(4, 5, 3))
