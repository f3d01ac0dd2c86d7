"""The core as torch operators: `render` and `voxelize` with gradients to splats and to the view's motion.

    image = ops.render(means, scales, quats, density, motion, frame, cone, rows, cols)
    volume = ops.voxelize(means, scales, quats, density, grid, nz, ny, nx)

Splats are float32 or float64, all four alike; motion and frame are float64 always. CPU. The gradients are the
core's own, so an optimiser written in torch meets the same numbers as `splatcore.descent`.
"""

from __future__ import annotations

import atexit
import math
import threading
from functools import lru_cache
from typing import Any

import torch
from torch import Tensor

from splatcore import _native


@lru_cache(maxsize=16)
def _renderer(rows: int, cols: int, double: bool, threads: int, caller: int) -> Any:
    """Scratch memory is kept between calls; it belongs to one calling thread."""
    return (_native.Renderer64 if double else _native.Renderer32)(rows, cols, threads)


def forget_renderers() -> None:
    """Free the cached scratch memory; the next calls use the instruction set that is chosen then."""
    _renderer.cache_clear()


atexit.register(forget_renderers)  # before the module that their type belongs to


def _renderer_for(means: Tensor, rows: int, cols: int) -> Any:
    return _renderer(rows, cols, means.dtype == torch.float64, torch.get_num_threads(), threading.get_ident())


def _check(means: Tensor, scales: Tensor, quats: Tensor, density: Tensor) -> None:
    """Shapes and types at the door; the core's own message lists every signature instead."""
    n = means.shape[0]
    if means.dtype not in (torch.float32, torch.float64):
        raise TypeError(f"splats must be float32 or float64, got {means.dtype}")
    for name, tensor, shape in (
        ("means", means, (n, 3)),
        ("scales", scales, (n, 3)),
        ("quats", quats, (n, 4)),
        ("density", density, (n,)),
    ):
        if tensor.shape != shape or tensor.dtype != means.dtype:
            raise ValueError(f"{name} must be {means.dtype} of shape {shape}, got {tensor.dtype} {tuple(tensor.shape)}")


def _plain(*tensors: Tensor) -> list[Tensor]:
    """As the core takes them."""
    return [t.detach().contiguous() for t in tensors]


def _check_view(motion: Tensor, frame: Tensor) -> None:
    for name, tensor, shape in (("motion", motion, (6,)), ("frame", frame, (4, 3))):
        if tensor.shape != shape or tensor.dtype != torch.float64:
            raise ValueError(f"{name} must be float64 of shape {shape}, got {tensor.dtype} {tuple(tensor.shape)}")


def _skew(w: Tensor) -> Tensor:
    """[3] -> [3, 3], the matrix of w x (.)"""
    x, y, z = w.tolist()
    return torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=torch.float64)


def exp_and_left_jacobian(omega: Tensor) -> tuple[Tensor, Tensor]:
    """Exp(omega) [3, 3], and J_l(omega) [3, 3] with Exp(omega + d) = Exp(J_l d) Exp(omega) to first order.

    Exp = 1 + (sin t / t) W + ((1 - cos t) / t^2) W^2, J_l = 1 + ((1 - cos t) / t^2) W + ((t - sin t) / t^3) W^2,
    W the matrix of omega x (.), t = |omega|; below 0.05 rad by their series, free of cancellation.
    """
    t2 = float(omega @ omega)
    t = t2**0.5
    if t < 0.05:
        a = 1 - t2 / 6 * (1 - t2 / 20 * (1 - t2 / 42 * (1 - t2 / 72)))
        b = 0.5 - t2 / 24 * (1 - t2 / 30 * (1 - t2 / 56 * (1 - t2 / 90)))
        c = (1 - t2 / 20 * (1 - t2 / 42 * (1 - t2 / 72 * (1 - t2 / 110)))) / 6
    else:
        a, b, c = math.sin(t) / t, (1 - math.cos(t)) / t2, (t - math.sin(t)) / (t2 * t)
    w = _skew(omega)
    one = torch.eye(3, dtype=torch.float64)
    return one + a * w + b * (w @ w), one + b * w + c * (w @ w)


def corrected_frame(frame: Tensor, motion: Tensor, cone: bool) -> Tensor:
    """The frame that sees x as `frame` sees Exp(omega) x + tau: (R'(s-t), R'(d-t), R'u, R'v). [4, 3]"""
    turn, _ = exp_and_left_jacobian(motion[:3])
    shift = torch.zeros(4, 3, dtype=torch.float64)
    shift[1] = motion[3:]
    if cone:
        shift[0] = motion[3:]
    return ((frame - shift) @ turn).contiguous()


@torch.library.custom_op("splatct::render", mutates_args=())
def render(
    means: Tensor,
    scales: Tensor,
    quats: Tensor,
    density: Tensor,
    motion: Tensor,
    frame: Tensor,
    cone: bool,
    rows: int,
    cols: int,
) -> Tensor:
    """Line integrals through splats on a rows x cols detector (the paper's eq. 5). [rows, cols]

    means, scales [n, 3] mm; quats [n, 4] w x y z of any length; density [n] 1/mm; motion [6] (omega rad, tau mm):
    the view sees x as `frame` sees Exp(omega) x + tau; frame [4, 3] mm: source (cone) or ray direction, detector
    centre, u, v. Differentiable in everything but the frame.
    """
    _check(means, scales, quats, density)
    _check_view(motion, frame)
    image = torch.empty(rows, cols, dtype=means.dtype)
    view = corrected_frame(frame.detach(), motion.detach(), cone)
    _renderer_for(means, rows, cols).render(view, cone, *_plain(means, scales, quats, density), image)
    return image


@torch.library.custom_op("splatct::render_vjp", mutates_args=())
def render_vjp(
    v_image: Tensor,
    means: Tensor,
    scales: Tensor,
    quats: Tensor,
    density: Tensor,
    motion: Tensor,
    frame: Tensor,
    cone: bool,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Reverse of `render` for dL/dimage [rows, cols]: dL/d(means, scales, quats, density, motion).

    The core answers for a motion (w, t) applied before the present pose, R (Exp(w) x + t) + tau. From
    Exp(omega + d) = Exp(omega) Exp(J_l(omega)' d): dL/domega = J_l dL/dw and dL/dtau = R dL/dt.
    """
    *splats, v_pixels = _plain(means, scales, quats, density, v_image)
    gradients = [torch.empty_like(t) for t in splats]
    v_world = torch.empty(6, dtype=torch.float64)
    view = corrected_frame(frame.detach(), motion.detach(), cone)
    _renderer_for(means, *v_image.shape).render_vjp(view, cone, *splats, v_pixels, *gradients, v_world)
    turn, jacobian = exp_and_left_jacobian(motion.detach()[:3])
    v_motion = torch.cat([jacobian @ v_world[:3], turn @ v_world[3:]])
    v_means, v_scales, v_quats, v_density = gradients
    return v_means, v_scales, v_quats, v_density, v_motion


@render.register_fake
def _(
    means: Tensor,
    scales: Tensor,
    quats: Tensor,
    density: Tensor,
    motion: Tensor,
    frame: Tensor,
    cone: bool,
    rows: int,
    cols: int,
) -> Tensor:
    return means.new_empty(rows, cols)


@render_vjp.register_fake
def _(
    v_image: Tensor,
    means: Tensor,
    scales: Tensor,
    quats: Tensor,
    density: Tensor,
    motion: Tensor,
    frame: Tensor,
    cone: bool,
) -> tuple[Tensor, ...]:
    return tuple(t.new_empty(t.shape) for t in (means, scales, quats, density, motion))


def _keep_render(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
    *tensors, ctx.cone, _, _ = inputs
    ctx.save_for_backward(*tensors)


def _render_backward(ctx: Any, v_image: Tensor) -> tuple[Tensor | None, ...]:
    return (*render_vjp(v_image, *ctx.saved_tensors, ctx.cone), None, None, None, None)


render.register_autograd(_render_backward, setup_context=_keep_render)


@torch.library.custom_op("splatct::voxelize", mutates_args=())
def voxelize(
    means: Tensor, scales: Tensor, quats: Tensor, density: Tensor, grid: Tensor, nz: int, ny: int, nx: int
) -> Tensor:
    """The splats' density at voxel centres. [nz, ny, nx] 1/mm

    grid [2, 3] float64: voxel size z, y, x and centre x, y, z, mm (`splatcore.splats.grid_array`).
    Differentiable in the splats.
    """
    _check(means, scales, quats, density)
    if grid.shape != (2, 3) or grid.dtype != torch.float64:
        raise ValueError(f"grid must be float64 of shape (2, 3), got {grid.dtype} {tuple(grid.shape)}")
    volume = torch.empty(nz, ny, nx, dtype=means.dtype)
    m, s, q, d = _plain(means, scales, quats, density)
    _native.voxelize(grid.detach().contiguous(), m, s, q, d, volume, torch.get_num_threads())
    return volume


@torch.library.custom_op("splatct::voxelize_vjp", mutates_args=())
def voxelize_vjp(
    v_volume: Tensor, means: Tensor, scales: Tensor, quats: Tensor, density: Tensor, grid: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Reverse of `voxelize` for dL/dvolume [nz, ny, nx]: dL/d(means, scales, quats, density)."""
    m, s, q, d, v = _plain(means, scales, quats, density, v_volume)
    v_m, v_s, v_q, v_d = (torch.empty_like(t) for t in (m, s, q, d))
    _native.voxelize_vjp(grid.detach().contiguous(), m, s, q, d, v, v_m, v_s, v_q, v_d, torch.get_num_threads())
    return v_m, v_s, v_q, v_d


@voxelize.register_fake
def _(means: Tensor, scales: Tensor, quats: Tensor, density: Tensor, grid: Tensor, nz: int, ny: int, nx: int) -> Tensor:
    return means.new_empty(nz, ny, nx)


@voxelize_vjp.register_fake
def _(
    v_volume: Tensor, means: Tensor, scales: Tensor, quats: Tensor, density: Tensor, grid: Tensor
) -> tuple[Tensor, ...]:
    return tuple(t.new_empty(t.shape) for t in (means, scales, quats, density))


def _keep_voxelize(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
    ctx.save_for_backward(*inputs[:5])


def _voxelize_backward(ctx: Any, v_volume: Tensor) -> tuple[Tensor | None, ...]:
    return (*voxelize_vjp(v_volume, *ctx.saved_tensors), None, None, None, None)


voxelize.register_autograd(_voxelize_backward, setup_context=_keep_voxelize)
