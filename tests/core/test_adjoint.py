"""Operators and the reverses they claim: |<Ax, y> - <x, A'y>| / (|Ax| |y|), on every instruction set."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from splatcore import _native, ops
from splatcore.geometry import Beam, Frames, RigidMotions

from ..tolerances import ADJOINT, name_of
from . import scenes
from .scenes import COLS, MOTION, ROWS
from .test_ops_match_reference import GRID, SHAPE

DTYPES = pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=name_of)


def random(seed: int, *shape: int) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def mismatch(ax: Tensor, y: Tensor, x: Tensor, aty: Tensor) -> float:
    ax, y, x, aty = (t.double().flatten() for t in (ax, y, x, aty))
    return float((ax @ y - x @ aty).abs() / (ax.norm() * y.norm()))


def turned(beam: Beam) -> list[np.ndarray]:
    """Frames whose rays run mainly along x, y and z, and one exactly along x. Each [4, 3] mm"""
    orbit = scenes.frames(beam)
    over = RigidMotions.exp(np.array([[0.9, 0.8, 0.1]]), np.array([[3.0, 1.0, -2.0]])).correct(orbit[0:1])
    first = (500.0, 0.0, 0.0) if beam == "cone" else (-1.0, 0.0, 0.0)
    plain = np.array([[first], [(-200.0, 0, 0)], [(0, 6.5, 0)], [(0, 0, -7.0)]])
    flat = Frames(beam, *plain, ROWS, COLS)
    return [view for frames in (orbit[0:2], over, flat) for view in frames.packed()]


@pytest.mark.parametrize("view", range(4))
@pytest.mark.parametrize("beam", ["cone", "parallel"])
@DTYPES
def test_project_volume(isa: str, dtype: torch.dtype, beam: Beam, view: int) -> None:
    """Parts of the volume are out of view, parts of the detector see no volume."""
    frame = turned(beam)[view]
    x, y = random(1, *SHAPE).to(dtype), random(2, ROWS, COLS).to(dtype)
    image, volume = torch.full_like(y, 7.0), torch.zeros_like(x)
    _native.project_volume(frame, beam == "cone", GRID, x, image, 2)
    _native.project_volume_adjoint(frame, beam == "cone", GRID, y, volume, 2)
    assert image.norm() > 0
    assert mismatch(image, y, x, volume) < ADJOINT[name_of(dtype)]


def test_the_adjoint_is_the_transposed_matrix(isa: str) -> None:
    """Entry by entry, and it adds to what is there."""
    frame, shape, rows, cols = turned("cone")[2], (3, 4, 5), 4, 3
    grid = torch.tensor([[30.0, 25.0, 20.0], [4.0, 1.0, -2.0]], dtype=torch.float64)
    forward, reverse = np.zeros((rows * cols, 60)), np.zeros((rows * cols, 60))
    frame[2:] *= 12
    for k in range(60):
        volume, image = np.zeros(shape), np.empty((rows, cols))
        volume.flat[k] = 1
        _native.project_volume(frame, True, grid, volume, image, 1)
        forward[:, k] = image.ravel()
    for k in range(rows * cols):
        volume, image = np.full(shape, 10.0), np.zeros((rows, cols))
        image.flat[k] = 1
        _native.project_volume_adjoint(frame, True, grid, image, volume, 1)
        reverse[k] = volume.ravel() - 10
    assert forward.max() > 10
    np.testing.assert_allclose(reverse, forward, atol=1e-13)


@pytest.mark.parametrize("beam", ["cone", "parallel"])
@DTYPES
def test_render_is_linear_in_the_density(isa: str, dtype: torch.dtype, beam: Beam) -> None:
    """A(ax + by) = a Ax + b Ay, and the gradient of the density is A'."""
    m, s, q, d = scenes.cloud(200).to(dtype).tensors()
    view, motion = scenes.frame(beam), MOTION
    other = random(3, 200).to(dtype)

    def a(x: Tensor) -> Tensor:
        return ops.render(m, s, q, x, motion, view, beam == "cone", ROWS, COLS)

    both = a(2 * d - 3 * other)
    assert (both - 2 * a(d) + 3 * a(other)).norm() < 10 * ADJOINT[name_of(dtype)] * both.norm()
    y = random(4, ROWS, COLS).to(dtype)
    _, _, _, aty, _ = ops.render_vjp(y, m, s, q, d, motion, view, beam == "cone")
    assert mismatch(a(other), y, other, aty) < ADJOINT[name_of(dtype)]


@DTYPES
def test_voxelize_is_linear_in_the_density(isa: str, dtype: torch.dtype) -> None:
    m, s, q, d = scenes.cloud(200).to(dtype).tensors()
    other = random(3, 200).to(dtype)

    def a(x: Tensor) -> Tensor:
        return ops.voxelize(m, s, q, x, GRID, *SHAPE)

    both = a(2 * d - 3 * other)
    assert (both - 2 * a(d) + 3 * a(other)).norm() < 10 * ADJOINT[name_of(dtype)] * both.norm()
    y = random(4, *SHAPE).to(dtype)
    _, _, _, aty = ops.voxelize_vjp(y, m, s, q, d, GRID)
    assert mismatch(a(other), y, other, aty) < ADJOINT[name_of(dtype)]
