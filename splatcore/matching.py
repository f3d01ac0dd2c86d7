"""The classical way to find poses with the volume: reconstruct, re-project, register, and again.

Projection matching, as in electron and X-ray microscopy (Penczek et al. 1994; Guersoy et al. 2017): SART with the poses
found so far, then every view's six numbers by Gauss-Newton on what its re-projection misses, the derivatives by
finite differences of the voxel projector. Coarse to fine; the freedoms that no projection shows are settled as
everywhere in this engine. Nothing of it uses splats.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from splatcore import _native
from splatcore.classical import sart
from splatcore.gauge import settle
from splatcore.geometry import Array, Frames, RigidMotions
from splatcore.grid import VolumeGrid
from splatcore.pyramid import Level, factors, level
from splatcore.scan import Scan
from splatcore.splats import Floats, grid_array

_STEP_PX = 0.3  # finite differences: how far a step moves the object, in pixels of the level
_REACH_PX = 1.5  # longest step of a view
_PRIOR_DEG, _PRIOR_SHARE = 5.0, 0.1  # standard deviations: of rotations, and of translations in half widths


@dataclass(frozen=True)
class Schedule:
    """How long to work at each binning factor."""

    rounds: tuple[tuple[int, int], ...] = ((8, 10), (4, 8), (2, 5), (1, 2))  # (factor, rounds)
    iterations: int = 2  # of SART in a round
    last: int = 8  # of SART with the final poses
    subset: int = 5  # views in a step of SART
    relaxation: float = 0.5
    caution: float = 100.0  # pixels that count as one measurement against the prior: neighbours err alike


def match(scan: Scan, threads: int, schedule: Schedule | None = None) -> tuple[Floats, RigidMotions]:
    """The volume [z, y, x] 1/mm of the scan's own grid, and every view's correction. Deterministic."""
    schedule = schedule or Schedule()
    planned = dict(schedule.rounds)
    scales = [f for f in factors(scan, 1) if f in planned] or [1]
    motions = RigidMotions.identity(len(scan.frames))
    volume: Floats | None = None
    for factor in scales:
        here = level(scan, factor)
        volume = None if volume is None else _refined(volume, here.grid)
        for _ in range(planned.get(factor, 1)):
            volume = _volume(here, motions, volume, schedule.iterations, schedule, threads)
            motions = _register(here, motions, volume, schedule.caution, threads)
            _, motions = settle(here.nominal, motions)
    finest = level(scan, 1)
    if volume is not None and scales[-1] != 1:
        volume = _refined(volume, finest.grid)
    return _volume(finest, motions, volume, schedule.last, schedule, threads), motions


def _volume(
    here: Level, motions: RigidMotions, start: Floats | None, iterations: int, schedule: Schedule, threads: int
) -> Floats:
    return sart(
        here.images, motions.correct(here.nominal), here.grid, threads, iterations=iterations, subset=schedule.subset,
        relaxation=schedule.relaxation, start=start,
    )  # fmt: skip


def _register(here: Level, motions: RigidMotions, volume: Floats, caution: float, threads: int) -> RigidMotions:
    """One Gauss-Newton step of every view."""
    radius = float(here.grid.half_extent_mm().max())
    step = _STEP_PX * here.pixel_at_isocentre_mm
    steps = np.array([step / radius] * 3 + [step] * 3)
    limit = steps * (_REACH_PX / _STEP_PX) * np.array([1, 1, 1, 3, 3, 3])
    deviation = np.array([np.deg2rad(_PRIOR_DEG)] * 3 + [_PRIOR_SHARE * radius] * 3)
    moves = RigidMotions.exp(np.diag(steps)[:, :3], np.diag(steps)[:, 3:])
    found = np.empty((len(motions.rotation), 6))
    offset = np.concatenate(motions.vectors(), axis=1)
    weight = 1.0 if here.mask is None else here.mask
    for view in range(len(found)):
        pose = RigidMotions(motions.rotation[[view]], motions.translation[[view]])
        nominal = here.nominal[view : view + 1]
        base = _image(volume, here.grid, pose.correct(nominal), threads)
        residual: Array = (weight * (base - here.images[view])).ravel().astype(np.float64)
        derivative = np.empty((6, residual.size))
        for k in range(6):
            one = RigidMotions(moves.rotation[[k]], moves.translation[[k]])
            moved = _image(volume, here.grid, (pose @ one).correct(nominal), threads)
            derivative[k] = (weight * (moved - base)).ravel() / steps[k]
        found[view] = gauss_newton(derivative, residual, offset[view], deviation, limit, caution)
    return motions @ RigidMotions.exp(found[:, :3], found[:, 3:])


def gauss_newton(
    derivative: Array, residual: Array, offset: Array, deviation: Array, limit: Array, caution: float = 1.0
) -> Array:
    """The step [6] of one view: normal equations over the residual's variance, plus the prior that the pose, now at
    `offset`, is normal about nominal with `deviation`. Shortened as a whole where a component exceeds `limit`.
    caution: pixels that count as one measurement."""
    variance = caution * max(float(residual @ residual) / residual.size, 1e-20)
    precision = 1 / deviation**2
    hessian = derivative @ derivative.T / variance + np.diag(precision)
    slope = derivative @ residual / variance + precision * offset
    step = -np.linalg.solve(hessian, slope)
    return np.asarray(step / max(1.0, float(np.abs(step / limit).max())), np.float64)


def _image(volume: Floats, grid: VolumeGrid, frame: Frames, threads: int) -> Floats:
    """The re-projection of one view. [rows, cols]"""
    image = np.empty((frame.rows, frame.cols), np.float32)
    _native.project_volume(frame.packed()[0], frame.beam == "cone", grid_array(grid), volume, image, threads)
    return image


def _refined(volume: Floats, grid: VolumeGrid) -> Floats:
    """A coarse volume on a finer grid of the same middle, by linear interpolation."""
    ratio = [coarse / fine for coarse, fine in zip(volume.shape, grid.shape, strict=True)]
    whole = [max(1, round(1 / r)) for r in ratio]  # voxels of the fine grid in one of the coarse
    axes = [
        (np.arange(n) - (n - 1) / 2) / w + (m - 1) / 2 for n, w, m in zip(grid.shape, whole, volume.shape, strict=True)
    ]
    points = np.stack(np.meshgrid(*axes, indexing="ij"))
    fine: Floats = ndimage.map_coordinates(volume, points, order=1, mode="nearest").astype(np.float32)
    return fine
