"""Finite differences through the native float64 path, all inputs at once; and what torch asks of an operator."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from splatcore import ops
from splatcore.geometry import Beam

from . import scenes
from .scenes import MOTION, NO_MOTION, Cloud
from .test_ops_match_reference import GRID

ROWS, COLS = 11, 19


def small(n: int = 4) -> Cloud:
    """So wide that no pixel is near the cutoff, where the image jumps by 3.4e-4 of a splat's peak."""
    c = scenes.cloud(n, seed=5, sigma=60.0, spread=40.0)
    return Cloud(c.means, c.scales.clamp(min=45.0), c.quats, c.density)


@pytest.mark.parametrize("motion", [NO_MOTION, 1e-3 * MOTION, MOTION, 4 * MOTION], ids=["0", "1e-3", "1", "4"])
@pytest.mark.parametrize("beam", ["cone", "parallel"])
def test_render(isa: str, beam: Beam, motion: Tensor) -> None:
    """Splats and motion; 4 is a turn by 2.5 rad."""
    inputs = [*small().leaves(), motion.clone().requires_grad_()]
    view = scenes.frame(beam)

    def image(*x: Tensor) -> Tensor:
        return ops.render(*x, view, beam == "cone", ROWS, COLS)

    assert torch.autograd.gradcheck(image, inputs, eps=1e-5, atol=1e-7, rtol=1e-6, fast_mode=True)


def test_every_entry_of_the_jacobian() -> None:
    """Not only a random combination of them."""
    inputs = [*small(2).leaves(), MOTION.clone().requires_grad_()]

    def image(*x: Tensor) -> Tensor:
        return ops.render(*x, scenes.frame("cone"), True, 5, 6)

    assert torch.autograd.gradcheck(image, inputs, eps=1e-5, atol=1e-7, rtol=1e-6)


def test_voxelize(isa: str) -> None:
    def volume(*x: Tensor) -> Tensor:
        return ops.voxelize(*x, GRID, 5, 6, 7)

    assert torch.autograd.gradcheck(volume, small().leaves(), eps=1e-5, atol=1e-7, rtol=1e-6, fast_mode=True)


@pytest.mark.parametrize("omega", [0.0, 1e-9, 1e-4, 0.0499, 0.0501, 1.0, 3.1])
def test_the_left_jacobian_is_the_derivative_of_exp(omega: float) -> None:
    """Exp(omega + d) Exp(omega)' = 1 + [J_l d] to first order, also where the series takes over."""
    w = omega * MOTION[:3] / MOTION[:3].norm()
    turn, jacobian = ops.exp_and_left_jacobian(w)
    assert torch.allclose(turn @ turn.T, torch.eye(3, dtype=torch.float64), atol=1e-15)
    step = 1e-5
    for k in range(3):
        d = step * torch.eye(3, dtype=torch.float64)[k]
        plus, minus = (ops.exp_and_left_jacobian(w + s * d)[0] for s in (1, -1))
        change = (plus - minus) / (2 * step) @ turn.T  # [3, 3], antisymmetric
        vector = torch.stack([change[2, 1], change[0, 2], change[1, 0]])
        assert torch.allclose(vector, jacobian[:, k], atol=1e-9)


# torch's own tracing warns about its own use of deprecated parts.
@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::FutureWarning", "ignore::UserWarning")
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_opcheck(dtype: torch.dtype) -> None:
    """Schema, fake tensors, autograd registration, tracing with dynamic shapes."""
    leaves = small().to(dtype).leaves()
    view, motion = scenes.frame("cone"), MOTION.clone().requires_grad_()
    torch.library.opcheck(ops.render, (*leaves, motion, view, True, ROWS, COLS))
    torch.library.opcheck(ops.voxelize, (*leaves, GRID, 5, 6, 7))
    plain = [t.detach() for t in leaves]
    torch.library.opcheck(ops.render_vjp, (torch.ones(ROWS, COLS, dtype=dtype), *plain, MOTION, view, True))
    torch.library.opcheck(ops.voxelize_vjp, (torch.ones(5, 6, 7, dtype=dtype), *plain, GRID))
