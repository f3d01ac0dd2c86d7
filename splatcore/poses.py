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

    hessian: Array  # [views, 12, 12]: omega, tau, strain
    gradient: Array  # [views, 12]
    weighted_ss: Array  # [views] sum w r^2
    residual_ss: Array  # [views] sum r^2
    residual_abs: Array  # [views] sum |r|
    pixels: Array  # [views]

    @property
    def rms(self) -> Array:
        return np.sqrt(self.residual_ss / np.maximum(self.pixels, 1))

    @property
    def noise(self) -> Array:
        """Variance of a pixel's residual, six numbers fitted. [views]"""
        return np.maximum(self.weighted_ss / np.maximum(self.pixels - 6, 1), 1e-20)

    @property
    def rigid(self) -> Array:
        """The block of the view's own motion. [views, 6, 6]"""
        return self.hessian[:, :6, :6]

    def explained(self) -> Array:
        """Share of each view's residual variance that a rigid motion of the view explains (the paper's
        directional bias at edges, as one number). A view without misalignment has 6 / pixels. [views]"""
        ridge = 1e-9 * np.trace(self.rigid, axis1=1, axis2=2)[:, None, None] * np.eye(6) / 6
        step = np.linalg.solve(self.rigid + ridge + 1e-30 * np.eye(6), self.gradient[:, :6, None])[..., 0]
        return np.einsum("vi,vi->v", step, self.gradient[:, :6]) / np.maximum(self.weighted_ss, 1e-30)


@dataclass(frozen=True)
class Prior:
    """How far poses may be from nominal, one standard deviation per axis."""

    rotation: float  # rad
    translation: float  # mm
    strain: float = 0.01  # of the object, in one sweep

    def precision(self) -> Array:
        return np.array([1 / self.rotation**2] * 3 + [1 / self.translation**2] * 3)


def accumulate(
    renderer: _native.Renderer32, splats: Splats, frames: Frames, targets: Floats, mask: Floats | None, huber: float
) -> Normals:
    """The normal equations of all views."""
    views = len(frames)
    hessian, gradient, sums = np.zeros((views, 12, 12)), np.zeros((views, 12)), np.zeros((views, 4))
    packed = frames.packed()
    for k in range(views):
        sums[k] = renderer.motion_normal(
            packed[k], frames.beam == "cone", *splats.arrays(), targets[k], mask, huber, hessian[k], gradient[k]
        )
    return Normals(hessian, gradient, *sums.T)


def step_full(
    normals: Normals, motions: RigidMotions, prior: Prior, limit: Array, caution: float = 1.0
) -> tuple[RigidMotions, Array]:
    """New poses after one damped Gauss-Newton step, and the strain [3, 3] that the object's means must follow.

    Views and strain are solved jointly (Schur complement of the arrow-shaped system): a stretched object seen
    from slightly wrong angles and distances is nearly the same scan, and alternation alone takes hundreds of
    sweeps to find its way along that valley.
    limit [6]: no component of a view's step exceeds it (rad, mm); the whole step is shortened instead.
    caution: how many pixels count as one independent measurement against the prior.
    """
    noise = caution * normals.noise
    precision = prior.precision()
    offset = np.concatenate(motions.vectors(), axis=1)
    hessian = normals.hessian / noise[:, None, None]
    gradient = normals.gradient / noise[:, None]
    views = hessian[:, :6, :6] + np.diag(precision)
    views += 1e-3 * views * np.eye(6)
    pull = gradient[:, :6] + precision * offset
    mixed = hessian[:, :6, 6:]
    solved = np.linalg.solve(views, np.concatenate([pull[..., None], mixed], axis=2))
    schur = hessian[:, 6:, 6:].sum(axis=0) - np.einsum("vij,vik->jk", mixed, solved[..., 1:])
    schur += 1e-3 * np.diag(np.diag(schur)) + np.eye(6) / prior.strain**2
    right = gradient[:, 6:].sum(axis=0) - np.einsum("vij,vi->j", mixed, solved[..., 0])
    strain = np.clip(-np.linalg.solve(schur, right), -0.01, 0.01)
    step = -solved[..., 0] - solved[..., 1:] @ strain
    step /= np.maximum(1.0, np.abs(step / limit).max(axis=1))[:, None]
    xx, yy, zz, yz, xz, xy = strain
    return (
        motions @ RigidMotions.exp(step[:, :3], step[:, 3:]),
        np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]),
    )


def step_static(normals: Normals, frames: Frames, offset_mm: float, prior: Prior) -> float:
    """The centre of rotation after one Gauss-Newton step: how far the axis lies from nominal along u, in mm at the
    isocentre. All views share it; its derivative is that of the object shifted along u."""
    along = _along_u(frames)
    noise = normals.noise
    curvature = np.einsum("vi,vij,vj->v", along, normals.hessian[:, 3:6, 3:6], along) / noise
    slope = np.einsum("vi,vi->v", along, normals.gradient[:, 3:6]) / noise
    precision = 1 / prior.translation**2
    return offset_mm - float((slope.sum() + precision * offset_mm) / (curvature.sum() + precision))


def off_centre(frames: Frames, offset_mm: float) -> Frames:
    """A scanner whose axis lies `offset_mm` from nominal along u: the detector moved the other way, by as much as
    that is at the detector. Median magnification over views."""
    width = np.linalg.norm(frames.u, axis=1) * frames.isocentre_depth()
    return frames.shifted_detector(-offset_mm / float(np.median(width)))


def split_static(frames: Frames, motions: RigidMotions) -> tuple[float, RigidMotions]:
    """(the mean shift along u in mm, the motions without it): static and per-view parts share no direction."""
    along = _along_u(frames)
    offset = float(np.einsum("vi,vi->v", along, motions.translation).mean())
    return offset, RigidMotions(motions.rotation, motions.translation - offset * along)


def _along_u(frames: Frames) -> Array:
    return frames.u / np.linalg.norm(frames.u, axis=1, keepdims=True)


def axis_column(corrected: Frames) -> float:
    """`cor_px`: the detector column on which the rotation axis falls at the isocentre's height, mean over views."""
    return float(corrected.project(np.zeros((1, 3)))[:, 0, 0].mean())


def sigmas(normals: Normals, prior: Prior) -> tuple[Array, Array]:
    """One standard deviation of rotation [views, 3] rad and translation [views, 3] mm, the volume taken as known."""
    noise = normals.noise
    precision = normals.rigid / noise[:, None, None] + np.diag(prior.precision())
    deviation = np.sqrt(np.diagonal(np.linalg.inv(precision), axis1=1, axis2=2))
    return deviation[:, :3], deviation[:, 3:]
