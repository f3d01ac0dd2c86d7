"""The normal equations of a view against derivatives that are built some other way."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.autograd.functional import jvp

from splatcore import _native, ops, reference
from splatcore.geometry import Beam

from . import scenes
from .scenes import COLS, NO_MOTION, ROWS, Cloud

BEAMS = pytest.mark.parametrize("beam", ["cone", "parallel"])
WIDE = 1e9  # a Huber delta that weights nothing


@dataclass(frozen=True)
class Sums:
    hessian: Tensor  # [12, 12]
    gradient: Tensor  # [12]
    weighted_ss: float
    residual_ss: float
    residual_abs: float
    pixels: float


def native(
    cloud: Cloud, view: Tensor, beam: Beam, target: Tensor, mask: Tensor | None = None, huber: float = WIDE
) -> Sums:
    make = _native.Renderer64 if target.dtype == torch.float64 else _native.Renderer32
    hessian, gradient = torch.empty(12, 12, dtype=torch.float64), torch.empty(12, dtype=torch.float64)
    sums = make(ROWS, COLS, 2).motion_normal(
        view, beam == "cone", *cloud.tensors(), target, mask, huber, hessian, gradient
    )
    return Sums(hessian, gradient, *sums)


@cache
def derivative_images(beam: Beam) -> Tensor:
    """Column by column from the twin: six motions of the object, six strains of the means. [12, r, c]"""
    c, view = scenes.cloud(), scenes.frame(beam)

    def image(direction: Tensor) -> Tensor:
        xx, yy, zz, yz, xz, xy = direction[6:]
        strain = torch.stack([xx, xy, xz, xy, yy, yz, xz, yz, zz]).reshape(3, 3)
        means = c.means + c.means @ strain.T
        return reference.render(means, c.scales, c.quats, c.density, direction[:6], view, beam == "cone", ROWS, COLS)

    zero = torch.zeros(12, dtype=torch.float64)
    return torch.stack([jvp(image, zero, unit)[1] for unit in torch.eye(12, dtype=torch.float64)])


@dataclass(frozen=True)
class Scene:
    cloud: Cloud
    view: Tensor
    image: Tensor
    target: Tensor
    mask: Tensor

    @classmethod
    def of(cls, beam: Beam, n: int = 40) -> Scene:
        c, view = scenes.cloud(n), scenes.frame(beam)
        image = ops.render(*c.tensors(), NO_MOTION, view, beam == "cone", ROWS, COLS)
        rng = torch.Generator().manual_seed(2)
        noise = torch.randn(ROWS, COLS, generator=rng, dtype=torch.float64)
        mask = torch.rand(ROWS, COLS, generator=rng, dtype=torch.float64)
        return cls(c, view, image, image + 0.01 * noise, torch.where(mask < 0.2, 0.0, mask))


def same(actual: Tensor, expected: Tensor, rel: float = 1e-11) -> bool:
    """Relative to the size that each row and column would have: sqrt of the diagonal."""
    size = expected.diagonal().sqrt() if expected.dim() == 2 else expected.abs()
    scale = torch.outer(size, size) if expected.dim() == 2 else size
    return bool(((actual - expected).abs() <= rel * scale).all())


@BEAMS
def test_gradient_is_that_of_half_the_sum_of_squares(isa: str, beam: Beam) -> None:
    """The rigid part against render_vjp, the strain against moving the means by it."""
    s = Scene.of(beam)
    sums, residual = native(s.cloud, s.view, beam, s.target), s.image - s.target
    v_means, *_, v_motion = ops.render_vjp(residual, *s.cloud.tensors(), NO_MOTION, s.view, beam == "cone")
    assert torch.allclose(sums.gradient[:6], v_motion, rtol=1e-9, atol=1e-12 * v_motion.abs().max())
    pull = torch.einsum("ni,nj->ij", v_means, s.cloud.means)  # d/dE of E x
    pull = pull + pull.T
    strain = torch.stack([pull[0, 0] / 2, pull[1, 1] / 2, pull[2, 2] / 2, pull[1, 2], pull[0, 2], pull[0, 1]])
    assert torch.allclose(sums.gradient[6:], strain, rtol=1e-9, atol=1e-12 * strain.abs().max())


@BEAMS
def test_hessian_is_the_jacobian_squared(isa: str, beam: Beam) -> None:
    s = Scene.of(beam)
    sums, j = native(s.cloud, s.view, beam, s.target), derivative_images(beam)
    assert same(sums.hessian, torch.einsum("kij,lij->kl", j, j))
    assert torch.equal(sums.hessian, sums.hessian.T)
    residual = s.image - s.target
    expected = torch.einsum("kij,ij->k", j, residual)
    assert ((sums.gradient - expected).abs() < 1e-11 * j.norm(dim=(1, 2)) * residual.norm()).all()
    assert sums.pixels == ROWS * COLS
    assert sums.residual_ss == pytest.approx((residual**2).sum().item())
    assert sums.residual_abs == pytest.approx(residual.abs().sum().item())
    assert sums.weighted_ss == pytest.approx(sums.residual_ss)


@BEAMS
def test_huber_weights_and_mask(isa: str, beam: Beam) -> None:
    """w = mask min(1, delta / |r|); the plain sums know the mask alone."""
    s, delta = Scene.of(beam), 0.007
    sums, j = native(s.cloud, s.view, beam, s.target, s.mask, delta), derivative_images(beam)
    residual = s.image - s.target
    bent = residual.abs() > delta
    assert 0.2 < bent.double().mean() < 0.8
    weight = s.mask * torch.where(bent, delta / residual.abs(), 1.0)
    assert same(sums.hessian, torch.einsum("kij,ij,lij->kl", j, weight, j))
    expected = torch.einsum("kij,ij,ij->k", j, weight, residual)
    assert ((sums.gradient - expected).abs() < 1e-11 * j.norm(dim=(1, 2)) * residual.norm()).all()
    assert sums.weighted_ss == pytest.approx((weight * residual**2).sum().item())
    assert sums.residual_ss == pytest.approx((s.mask * residual**2).sum().item())
    assert sums.residual_abs == pytest.approx((s.mask * residual.abs()).sum().item())
    assert sums.pixels == pytest.approx(s.mask.sum().item())


@BEAMS
def test_float32_is_near(isa: str, beam: Beam) -> None:
    s = Scene.of(beam, 400)
    exact = native(s.cloud, s.view, beam, s.target)
    single = native(s.cloud.to(torch.float32), s.view, beam, s.target.float())
    assert same(single.hessian, exact.hessian, 2e-5)  # observed 3e-6
    assert ((single.gradient - exact.gradient).abs() < 2e-5 * exact.hessian.diagonal().sqrt()).all()


@BEAMS
def test_a_gauss_newton_step_finds_a_small_motion(beam: Beam) -> None:
    """The image of a moved object, and one step from the unmoved one: what remains is of second order."""
    s = Scene.of(beam, 400)
    motion = torch.tensor([2e-3, -1e-3, 3e-3, 0.05, -0.1, 0.08], dtype=torch.float64)
    target = ops.render(*s.cloud.tensors(), motion, s.view, beam == "cone", ROWS, COLS)
    sums = native(s.cloud, s.view, beam, target)
    if beam == "cone":
        step = torch.linalg.solve(sums.hessian[:6, :6], -sums.gradient[:6])
        assert (step - motion).norm() < 0.03 * motion.norm()
    rank = np.linalg.matrix_rank(sums.hessian[:6, :6].numpy() / np.outer(*[sums.hessian.diagonal()[:6].sqrt()] * 2))
    assert rank == (6 if beam == "cone" else 5)  # no parallel view sees its own shift along the ray
