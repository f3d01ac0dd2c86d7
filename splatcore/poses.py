"""Gauss-Newton on the poses: six numbers a view, from the exact derivative of the splatted image.

A view's increment is the rigid motion x -> Exp(omega) x + tau of the object in the world, applied before
the pose found so far. Its normal equations come from the core (`motion_normal`), with Huber weights; the
prior says how far the scanner's poses are from nominal; the inverse 6x6 is the pose's covariance.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from splatcore import _native
from splatcore.geometry import Array, Frames, RigidMotions
from splatcore.splats import Floats, Splats


@dataclass(frozen=True)
class Normals:
    """Normal equations of every view at its present pose. Units: rad, mm, unitless line integrals."""

    hessian: Array  # [views, 6, 6]
    gradient: Array  # [views, 6]
    weighted_ss: Array  # [views] sum w r^2
    residual_ss: Array  # [views] sum r^2
    residual_abs: Array  # [views] sum |r|
    pixels: Array  # [views]

    @property
    def rms(self) -> Array:
        return np.sqrt(self.residual_ss / np.maximum(self.pixels, 1))

    def explained(self) -> Array:
        """Share of each view's residual variance that a rigid motion of the view explains (the paper's
        directional bias at edges, as one number). A view without misalignment has 6 / pixels. [views]"""
        ridge = 1e-9 * np.trace(self.hessian, axis1=1, axis2=2)[:, None, None] * np.eye(6) / 6
        step = np.linalg.solve(self.hessian + ridge + 1e-30 * np.eye(6), self.gradient[..., None])[..., 0]
        return np.einsum("vi,vi->v", step, self.gradient) / np.maximum(self.weighted_ss, 1e-30)


@dataclass(frozen=True)
class Prior:
    """How far poses may be from nominal, one standard deviation per axis."""

    rotation: float  # rad
    translation: float  # mm

    def precision(self) -> Array:
        return np.array([1 / self.rotation**2] * 3 + [1 / self.translation**2] * 3)


def accumulate(
    renderer: _native.Renderer32, splats: Splats, frames: Frames, targets: Floats, mask: Floats | None, huber: float
) -> Normals:
    """The normal equations of all views."""
    views = len(frames)
    hessian, gradient, sums = np.zeros((views, 6, 6)), np.zeros((views, 6)), np.zeros((views, 4))
    packed = frames.packed()
    for k in range(views):
        sums[k] = renderer.motion_normal(
            packed[k], frames.beam == "cone", *splats.arrays(), targets[k], mask, huber, hessian[k], gradient[k]
        )
    return Normals(hessian, gradient, *sums.T)


def step_full(normals: Normals, motions: RigidMotions, prior: Prior, limit: Array, gain: float) -> RigidMotions:
    """New poses after one damped Gauss-Newton step of every view.

    limit [6]: no component of a step exceeds it (rad, mm); the whole step is shortened instead.
    gain over-relaxes: the volume has partly absorbed each view's misalignment, so steps fall short.
    """
    noise = np.maximum(normals.weighted_ss / np.maximum(normals.pixels - 6, 1), 1e-20)
    precision = prior.precision()
    omega, tau = motions.vectors()
    offset = np.concatenate([omega, tau], axis=1)
    hessian = normals.hessian / noise[:, None, None] + np.diag(precision)
    hessian += 1e-3 * hessian * np.eye(6)
    gradient = normals.gradient / noise[:, None] + precision * offset
    step = -gain * np.linalg.solve(hessian, gradient[..., None])[..., 0]
    step /= np.maximum(1.0, np.abs(step / limit).max(axis=1))[:, None]
    return motions @ RigidMotions.exp(step[:, :3], step[:, 3:])


def sigmas(normals: Normals, prior: Prior) -> tuple[Array, Array]:
    """One standard deviation of rotation [views, 3] rad and translation [views, 3] mm, the volume taken as known."""
    noise = np.maximum(normals.weighted_ss / np.maximum(normals.pixels - 6, 1), 1e-20)
    precision = normals.hessian / noise[:, None, None] + np.diag(prior.precision())
    deviation = np.sqrt(np.diagonal(np.linalg.inv(precision), axis1=1, axis2=2))
    return deviation[:, :3], deviation[:, 3:]
