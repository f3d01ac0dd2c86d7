"""The loss and its gradient, against torch with autograd all the way."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.nn.functional import conv2d

from splatcore import _native, ops, reference
from splatcore.geometry import Beam

from ..tolerances import gradient_error
from . import scenes
from .scenes import COLS, NO_MOTION, ROWS

HUBER, RANGE = 0.004, 0.3


def huber(residual: Tensor) -> Tensor:
    size = residual.abs()
    return torch.where(size < HUBER, residual**2 / (2 * HUBER), size - HUBER / 2)


def mean_ssim(x: Tensor, y: Tensor) -> Tensor:
    """Wang et al. 2004: a window of 11 x 11, sigma 1.5, zeros around the image. [r, c] x 2 -> []"""
    line = torch.exp(-(torch.arange(-5, 6, dtype=torch.float64) ** 2) / (2 * 1.5**2))  # [11]
    window = torch.outer(line, line)[None, None] / line.sum() ** 2  # [1, 1, 11, 11]

    def blur(image: Tensor) -> Tensor:
        return conv2d(image[None, None], window, padding=5)[0, 0]  # [r, c]

    mx, my = blur(x), blur(y)
    vx, vy, cov = blur(x * x) - mx**2, blur(y * y) - my**2, blur(x * y) - mx * my
    c1, c2 = (0.01 * RANGE) ** 2, (0.03 * RANGE) ** 2
    return ((2 * mx * my + c1) * (2 * cov + c2) / ((mx**2 + my**2 + c1) * (vx + vy + c2))).mean()


def scene(beam: Beam) -> tuple[list[Tensor], Tensor, Tensor, Tensor]:
    """Splats, the frame, a target like their image, and a mask of weights with dead pixels."""
    leaves, view = scenes.cloud().leaves(), scenes.frame(beam)
    image = ops.render(*leaves, NO_MOTION, view, beam == "cone", ROWS, COLS).detach()
    rng = torch.Generator().manual_seed(1)
    noise = torch.randn(ROWS, COLS, generator=rng, dtype=torch.float64)
    mask = torch.rand(ROWS, COLS, generator=rng, dtype=torch.float64)
    return leaves, view, 0.9 * image + 0.005 * noise, torch.where(mask < 0.1, 0.0, mask)


def native(
    leaves: list[Tensor], view: Tensor, cone: bool, target: Tensor, mask: Tensor | None, dssim: float
) -> tuple[float, list[Tensor]]:
    splats = [t.detach() for t in leaves]
    gradients = [torch.empty_like(t) for t in splats]
    make = _native.Renderer64 if target.dtype == torch.float64 else _native.Renderer32
    loss = make(ROWS, COLS, 2).loss_vjp(view, cone, *splats, target, mask, HUBER, dssim, RANGE, *gradients)
    return loss, gradients


@pytest.mark.parametrize("masked", [False, True], ids=["whole", "masked"])
@pytest.mark.parametrize("dssim", [0.0, 0.3, 1.0])
@pytest.mark.parametrize("beam", ["cone", "parallel"])
def test_loss_and_gradient(isa: str, beam: Beam, dssim: float, masked: bool) -> None:
    leaves, view, target, mask = scene(beam)
    loss, gradients = native(leaves, view, beam == "cone", target, mask if masked else None, dssim)
    image = ops.render(*leaves, NO_MOTION, view, beam == "cone", ROWS, COLS)
    on = mask if masked else torch.ones_like(mask)
    expected = (1 - dssim) * (on * huber(image - target)).mean()
    expected = expected + dssim * (1 - mean_ssim(on * image, on * target)) / 2
    assert loss == pytest.approx(expected.item(), rel=1e-12)
    for actual, twin in zip(gradients, torch.autograd.grad(expected, leaves), strict=True):
        assert gradient_error(actual, twin) < 1e-11


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32], ids=str)
@pytest.mark.parametrize("beam", ["cone", "parallel"])
def test_gradient_of_the_projected_centres(isa: str, beam: Beam, dtype: torch.dtype) -> None:
    """Against the twin with the centres as leaves of their own: footprints and amplitudes stay as they are."""
    leaves, view, target, mask = scene(beam)
    splats = [t.detach().to(dtype) for t in leaves]
    foot = reference.footprints(*[t.double() for t in splats], NO_MOTION, view, beam == "cone", ROWS, COLS)
    center = foot.center.requires_grad_()
    m = replace(foot, center=center).squared_distance(ROWS, COLS)
    values = torch.where(m < reference.CUTOFF, foot.amplitude[:, None, None] * torch.exp(-m / 2), 0.0)
    expected = (mask * huber(values.sum(dim=0) - target)).mean()
    gradients, v_center = [torch.empty_like(t) for t in splats], torch.full((len(center), 2), torch.nan, dtype=dtype)
    make = _native.Renderer64 if dtype == torch.float64 else _native.Renderer32
    images = [target.to(dtype), mask.to(dtype)]
    loss = make(ROWS, COLS, 2).loss_vjp(
        view, beam == "cone", *splats, *images, HUBER, 0.0, RANGE, *gradients, v_center=v_center
    )
    assert loss == pytest.approx(expected.item(), rel=1e-12 if dtype == torch.float64 else 1e-5)
    error = gradient_error(v_center, torch.autograd.grad(expected, center)[0])
    assert error < (1e-11 if dtype == torch.float64 else 1e-3)


def test_dead_pixels_do_not_matter(isa: str) -> None:
    """Whatever a masked pixel holds."""
    leaves, view, target, mask = scene("cone")
    wild = torch.where(mask == 0, 1e3, target)
    one, two = (native(leaves, view, True, t, mask, 0.4) for t in (target, wild))
    assert one[0] == two[0]
    assert all(torch.equal(a, b) for a, b in zip(one[1], two[1], strict=True))


def test_float32_is_near(isa: str) -> None:
    """SSIM divides by sums of variances; in single precision they carry fewer digits."""
    leaves, view, target, mask = scene("cone")
    loss, gradients = native(leaves, view, True, target, mask, 0.3)
    single, small = native([t.float() for t in leaves], view, True, target.float(), mask.float(), 0.3)
    assert single == pytest.approx(loss, rel=1e-5)
    for a, e in zip(small, gradients, strict=True):
        assert gradient_error(a, e) < 1e-3


@pytest.mark.parametrize("shape", [(1, 1), (3, 70), (40, 2), (16, 16)])
def test_images_smaller_than_the_window(shape: tuple[int, int]) -> None:
    """One splat as wide as the image; the loss alone."""
    c, view = scenes.cloud(1, sigma=50.0, spread=1.0), scenes.frame("parallel")
    target = torch.tensor(np.random.default_rng(0).uniform(0, 0.3, shape))
    gradients = [torch.empty_like(t) for t in c.tensors()]
    renderer = _native.Renderer64(*shape, 2)
    loss = renderer.loss_vjp(view, False, *c.tensors(), target, None, HUBER, 1.0, RANGE, *gradients)
    image = ops.render(*c.tensors(), NO_MOTION, view, False, *shape)
    assert loss == pytest.approx(float((1 - mean_ssim(image, target)) / 2), rel=1e-12)


@pytest.mark.parametrize("power", [-90, -30, 12, 40])
def test_no_unit_of_the_line_integrals_matters(isa: str, power: int) -> None:
    """Fourth powers of them would leave single precision."""
    leaves, view, target, mask = scene("cone")
    splats = [t.detach().float() for t in leaves]

    def found(unit: float) -> tuple[float, list[Tensor]]:
        scaled = [*splats[:3], splats[3] * unit]
        gradients = [torch.empty_like(t) for t in splats]
        loss = _native.Renderer32(ROWS, COLS, 2).loss_vjp(
            view, True, *scaled, target.float() * unit, mask.float(), HUBER * unit, 1.0, RANGE * unit, *gradients
        )
        return loss, [*gradients[:3], gradients[3] * unit]

    plain, other = found(1.0), found(2.0**power)
    assert other[0] == pytest.approx(plain[0], rel=1e-6)
    for a, e in zip(other[1], plain[1], strict=True):
        np.testing.assert_allclose(a, e, rtol=1e-4, atol=1e-6 * float(e.abs().max()))
