"""Classical iterative reconstruction on voxels, with Joseph's projector A and its exact adjoint A', arbitrary frames.

SART (Andersen and Kak 1984) in ordered subsets, and conjugate gradients on the normal equations (CGLS; Hestenes and
Stiefel 1952). Both bring min |A x - b| closer step by step; stopping early is what keeps noise out.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from splatcore import _native
from splatcore.geometry import Frames
from splatcore.grid import VolumeGrid
from splatcore.simulate import project
from splatcore.splats import Floats, grid_array

_FEWEST = 1e-3  # share of a view's longest ray, or of the best seen voxel's rays, below which nothing is divided by it


def backproject(images: Floats, frames: Frames, grid: VolumeGrid, threads: int) -> Floats:
    """A' of images [views, rows, cols]: the exact adjoint of `simulate.project`. [z, y, x]"""
    volume = np.zeros(grid.shape, np.float32)
    for frame, image in zip(frames.packed(), images, strict=True):
        _native.project_volume_adjoint(frame, frames.beam == "cone", grid_array(grid), image, volume, threads)
    return volume


def sart(
    projections: Floats,
    frames: Frames,
    grid: VolumeGrid,
    threads: int,
    *,
    iterations: int = 20,
    subset: int = 1,
    relaxation: float = 0.5,
    positivity: bool = True,
    start: Floats | None = None,
) -> Floats:
    """x <- x + relaxation D A_s' R (b_s - A_s x) over subsets s of views, all of them in one iteration.

    R divides by the length of each ray within the volume and D by the summed ray weights of each voxel, so that
    relaxation between 0 and 2 converges. projections [views, rows, cols]; subset: views in a step (1: SART; all of
    them: SIRT), which are spread over the orbit; start [z, y, x] 1/mm: zero where left out; it is not changed.
    Returns [z, y, x] 1/mm.
    """
    volume = np.zeros(grid.shape, np.float32) if start is None else start.astype(np.float32)  # a copy
    subsets = spread(len(frames), subset)
    weights = [_weights(frames[chosen], grid, threads) for chosen in subsets]
    for _ in range(iterations):
        for chosen, (lengths, cover) in zip(subsets, weights, strict=True):
            some = frames[chosen]
            residual = (projections[chosen] - project(volume, grid, some, threads)) * lengths
            volume += np.float32(relaxation) * cover * backproject(residual, some, grid, threads)
            if positivity:
                np.maximum(volume, 0, out=volume)
    return volume


def cgls(projections: Floats, frames: Frames, grid: VolumeGrid, threads: int, iterations: int = 20) -> Floats:
    """Conjugate gradients for A'A x = A'b from x = 0. projections [views, rows, cols]; returns [z, y, x] 1/mm.

    Stops before `iterations` once the gradient is down to the noise of single precision.
    """
    volume = np.zeros(grid.shape, np.float32)
    residual = projections.astype(np.float32)  # a copy
    gradient = backproject(residual, frames, grid, threads)
    direction = gradient.copy()
    first = steepness = _square(gradient)
    for _ in range(iterations):
        if steepness <= 1e-12 * first:
            break
        shadow = project(direction, grid, frames, threads)
        step = np.float32(steepness / _square(shadow))
        volume += step * direction
        residual -= step * shadow
        gradient = backproject(residual, frames, grid, threads)
        before, steepness = steepness, _square(gradient)
        direction *= np.float32(steepness / before)
        direction += gradient
    return volume


def spread(views: int, subset: int) -> list[NDArray[np.intp]]:
    """Views 0, k, 2k, ... then 1, k + 1, ...: subsets of about `subset` views, each spread over the orbit, visited so
    that two in a row lie far apart."""
    count = max(1, round(views / max(1, min(subset, views))))
    # Steps of the golden section over the subsets: none near the one before.
    order = np.argsort((np.arange(count) * 0.6180339887498949) % 1, kind="stable")
    return [np.arange(first, views, count) for first in order]


def _weights(frames: Frames, grid: VolumeGrid, threads: int) -> tuple[Floats, Floats]:
    """R [views, rows, cols] and D [z, y, x]; zero where there is next to nothing to divide by."""
    lengths = project(np.ones(grid.shape, np.float32), grid, frames, threads)
    ones = np.ones_like(lengths)
    return _inverse(lengths), _inverse(backproject(ones, frames, grid, threads))


def _inverse(weights: Floats) -> Floats:
    least = np.float32(max(_FEWEST * float(weights.max()), 1e-30))
    inverse: Floats = np.where(weights > least, 1 / np.maximum(weights, least), 0).astype(np.float32)
    return inverse


def _square(array: Floats) -> float:
    flat = array.ravel().astype(np.float64)
    return float(flat @ flat)
