"""The paper's pose increments: their chain rule, and that they are rigid motions of the object."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from splatcore import _native, ops
from splatcore.geometry import Beam, quaternion_from_rotation
from splatcore.increments import RATE, Increments, rotation

from . import scenes
from .scenes import COLS, NO_MOTION, ROWS


def moved(beam: Beam, seed: int = 0) -> Increments:
    """Away from nominal, quaternions longer than one."""
    increments = Increments(scenes.frames(beam), steps=100)
    increments.values[:] = np.random.default_rng(seed).normal(0, 0.1, increments.values.shape)
    increments.values[:, 4:] *= 30
    return increments


@pytest.mark.parametrize("beam", ["cone", "parallel"])
def test_chain_rule_against_finite_differences(beam: Beam) -> None:
    """Of the loss of one view in all seven numbers, through the core's own v_motion."""
    increments, view = moved(beam), 2
    cloud = scenes.cloud(6, sigma=40.0, spread=40.0)
    target = torch.rand(ROWS, COLS, generator=torch.Generator().manual_seed(0), dtype=torch.float64)

    def loss() -> float:
        frame = torch.tensor(increments.frame(view))
        image = ops.render(*cloud.tensors(), NO_MOTION, frame, beam == "cone", ROWS, COLS)
        return float(((image - target) ** 2).mean() / 2e-3)

    gradients = [torch.empty_like(t) for t in cloud.tensors()]
    v_motion = np.zeros(6)
    renderer = _native.Renderer64(ROWS, COLS, 1)
    # A corner beyond all residuals: the loss is mean r^2 / (2 delta).
    huber = 1e3
    value = renderer.loss_vjp(
        increments.frame(view), beam == "cone", *cloud.tensors(), target, None, huber, 0.0, 1.0, *gradients, v_motion
    )
    assert value * huber / 1e-3 == pytest.approx(loss(), rel=1e-9)
    ours = increments.chain(view, v_motion) * huber / 1e-3
    theirs = np.empty(7)
    for k in range(7):
        step = 1e-5 if k < 4 else 1e-3
        start = increments.values[view, k]
        increments.values[view, k] = start + step
        plus = loss()
        increments.values[view, k] = start - step
        theirs[k] = (plus - loss()) / (2 * step)
        increments.values[view, k] = start
    np.testing.assert_allclose(ours[:4], theirs[:4], rtol=1e-5, atol=1e-6 * np.abs(theirs[:4]).max())
    np.testing.assert_allclose(ours[4:], theirs[4:], rtol=1e-5, atol=1e-6 * np.abs(theirs[4:]).max())


@pytest.mark.parametrize("beam", ["cone", "parallel"])
def test_a_frame_is_the_nominal_one_corrected_by_the_motion(beam: Beam) -> None:
    increments = moved(beam)
    motions = increments.motions()
    np.testing.assert_allclose(
        motions.rotation @ np.swapaxes(motions.rotation, 1, 2), np.tile(np.eye(3), (5, 1, 1)), atol=1e-12
    )
    corrected = motions.correct(scenes.frames(beam)).packed()
    for view in range(5):
        np.testing.assert_allclose(increments.frame(view), corrected[view], atol=1e-10)


def test_the_camera_sees_w_x_plus_t() -> None:
    """World to camera is Rot(q0 + dq) x + t0 + dt, as the paper has it."""
    nominal, increments = scenes.frames("cone"), moved("cone")
    x = np.array([20.0, -31.0, 12.0])
    corrected = increments.motions().correct(nominal)
    for view in range(5):
        start = nominal.axes()[view]
        turn = rotation(quaternion_from_rotation(start) + increments.values[view, :4])
        expected = turn @ x - start @ nominal.source[view] + increments.values[view, 4:]
        seen = corrected.axes()[view] @ (x - corrected.source[view])
        np.testing.assert_allclose(seen, expected, atol=1e-9)


def test_zero_increments_leave_the_nominal_frames() -> None:
    nominal = scenes.frames("cone")
    increments = Increments(nominal, 10)
    np.testing.assert_allclose(increments.frame(1), nominal.packed()[1], atol=1e-10)


def test_only_the_drawn_view_moves_and_by_the_rate() -> None:
    """Adam's first step is the rate itself in every component, whatever the gradient; the rate falls to a tenth."""
    increments = Increments(replace(scenes.frames("cone")), steps=100)
    v_motion = np.array([1.0, -2.0, 0.5, 3.0, 0.1, -0.2])
    slope = increments.chain(2, v_motion)
    increments.step(2, v_motion, 0)
    np.testing.assert_allclose(increments.values[2], -RATE * np.sign(slope), rtol=1e-6)
    assert not increments.values[[0, 1, 3, 4]].any()
    increments.step(3, v_motion, 100)
    np.testing.assert_allclose(np.abs(increments.values[3]), RATE / 10, rtol=1e-6)
