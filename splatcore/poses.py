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
from splatcore.planar import in_plane
from splatcore.splats import Floats, Splats

_CLEAR = 0.1  # of the information about the turn that is shown best
_STILL = 1e4  # of the information about turns: as good as certain


@dataclass(frozen=True)
class Normals:
    """Normal equations of every view at its present pose. Units: rad, mm, unitless line integrals."""

    hessian: Array  # [views, n, n]: omega, tau, strain; with the detector's yaw (rad) n = 13, without it 12
    gradient: Array  # [views, n]
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
    """The normal equations of all views. A line detector shows motion in its own plane alone; what would leave the
    plane is taken out of them, so that poses and strain stay in it."""
    views = len(frames)
    hessian, gradient, sums = np.zeros((views, 12, 12)), np.zeros((views, 12)), np.zeros((views, 4))
    packed = frames.packed()
    for k in range(views):
        sums[k] = renderer.motion_normal(
            packed[k], frames.beam == "cone", *splats.arrays(), targets[k], mask, huber, hessian[k], gradient[k]
        )
    if frames.line:
        free = in_plane(frames)
        hessian, gradient = free @ hessian @ free, np.einsum("vij,vj->vi", free, gradient)
    return Normals(hessian, gradient, *sums.T)


def step_full(
    normals: Normals,
    motions: RigidMotions,
    prior: Prior,
    limit: Array,
    caution: float = 1.0,
    yaw: float = 0.0,
    found: Array | None = None,
    waiting: bool = False,
) -> tuple[RigidMotions, Array, float]:
    """New poses after one damped Gauss-Newton step, the strain [3, 3] that the object's means must follow, and the
    step of the detector's yaw, rad (zero where the normal equations do not hold it).

    Views and what they share are solved jointly (Schur complement of the arrow-shaped system): a stretched object seen
    from slightly wrong angles and distances is nearly the same scan, and alternation alone takes hundreds of
    sweeps to find its way along that valley.
    limit [6]: no component of a view's step exceeds it (rad, mm); the whole step is shortened instead.
    caution: how many pixels count as one independent measurement against the prior.
    yaw: the detector's present yaw, rad, which its prior pulls towards zero.
    found [views]: whether a view's place was found by a search. Where its image shows its motion clearly, its prior
    does without the caution, which would draw it back.
    waiting: turns that a view hardly shows stay as they are.
    """
    noise = caution * normals.noise
    precision = prior.precision()
    hold = np.tile(np.diag(precision), (len(motions), 1, 1))
    for view in [] if found is None else np.flatnonzero(found):
        clear = clear_directions(normals.rigid[view])
        hold[view] -= (1 - 1 / caution) * precision * (clear @ clear.T)
    offset = np.concatenate(motions.vectors(), axis=1)
    hessian = normals.hessian / noise[:, None, None]
    gradient = normals.gradient / noise[:, None]
    views = hessian[:, :6, :6] + hold
    views += 1e-3 * views * np.eye(6)
    if waiting:
        for block, rigid in zip(views, normals.rigid, strict=True):
            clear = clear_directions(rigid)
            if clear.shape[1] < 6:
                block += _STILL * np.trace(block[:3, :3]) * (np.eye(6) - clear @ clear.T)
    pull = gradient[:, :6] + np.einsum("vij,vj->vi", hold, offset)
    mixed = hessian[:, :6, 6:]
    solved = np.linalg.solve(views, np.concatenate([pull[..., None], mixed], axis=2))
    schur = hessian[:, 6:, 6:].sum(axis=0) - np.einsum("vij,vik->jk", mixed, solved[..., 1:])
    width = np.array([prior.strain] * 6 + [prior.rotation] * (schur.shape[0] - 6))
    schur += 1e-3 * np.diag(np.diag(schur)) + np.diag(1 / width**2)
    right = gradient[:, 6:].sum(axis=0) - np.einsum("vij,vi->j", mixed, solved[..., 0])
    right[6:] += yaw / prior.rotation**2
    shared = -np.linalg.solve(schur, right)
    shared[:6] = np.clip(shared[:6], -0.01, 0.01)
    step = -solved[..., 0] - solved[..., 1:] @ shared
    step /= np.maximum(1.0, np.abs(step / limit).max(axis=1))[:, None]
    xx, yy, zz, yz, xz, xy = shared[:6]
    return (
        motions @ RigidMotions.exp(step[:, :3], step[:, 3:]),
        np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]),
        float(shared[6]) if len(shared) > 6 else 0.0,
    )


def clear_directions(rigid: Array) -> Array:
    """An orthonormal basis [6, n] of the motions of one view that its image shows clearly, by its normal equations
    [6, 6]: all but turns that it shows far worse than others, as that of a nearly round object about its axis."""
    turn, mixed, shift = rigid[:3, :3], rigid[:3, 3:], rigid[3:, 3:]
    values, vectors = np.linalg.eigh(turn - mixed @ np.linalg.pinv(shift, rcond=1e-9, hermitian=True) @ mixed.T)
    clear = vectors[:, values > _CLEAR * values[-1]]
    return np.block([[clear, np.zeros((3, 3))], [np.zeros((3, clear.shape[1])), np.eye(3)]])


def sigmas(normals: Normals, prior: Prior) -> tuple[Array, Array]:
    """One standard deviation of rotation [views, 3] rad and translation [views, 3] mm, the volume taken as known."""
    noise = normals.noise
    precision = normals.rigid / noise[:, None, None] + np.diag(prior.precision())
    deviation = np.sqrt(np.diagonal(np.linalg.inv(precision), axis1=1, axis2=2))
    return deviation[:, :3], deviation[:, 3:]
