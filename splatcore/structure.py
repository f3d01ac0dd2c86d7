"""Splats shaped after the object: flat across its faces, long along its edges.

A round splat needs thousands of steps to become flat, and most never do. What the object looks like is known
beforehand, from the level above: its structure tensor says which way a face lies (Bigün and Granlund 1987).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy import ndimage
from scipy.spatial.transform import Rotation

from splatcore.geometry import Array
from splatcore.grid import VolumeGrid
from splatcore.splats import Floats, Splats

_ACROSS, _ALONG = 0.4, 2.2  # times the standard deviation, where there is nothing but a face
_FACE = 1 / 6  # rise within a standard deviation, as a share of what is dense in the volume, that makes a face
_SMOOTHED = 1.0  # voxels, before slopes are taken


def aligned(splats: Splats, volume: Floats, grid: VolumeGrid, thinnest: float = 0.0) -> Splats:
    """Round splats flattened and stretched after the faces of `volume` [z, y, x] in 1/mm; each keeps its integral.
    None gets thinner than `thinnest` mm.

    Of a grid that is one voxel thick they stay as they are.
    """
    top = float(np.percentile(volume, 99.9))
    if 1 in grid.shape or not top > 0:
        return splats
    sigma = float(np.median(splats.scales))
    values, axes = np.linalg.eigh(_structure(volume / np.float32(top), grid, sigma, splats.means))
    least, middle, most = np.maximum(values.T, 0)
    face = np.minimum(np.sqrt(most) * sigma / _FACE, 1)  # how steep
    flatness = face * (most - middle) / np.maximum(most, 1e-30)  # 0: as steep along another axis
    length = face * (most - least) / np.maximum(most, 1e-30)
    stretch = np.stack([1 + (_ALONG - 1) * length, 1 + (_ALONG - 1) * flatness, 1 - (1 - _ACROSS) * flatness], axis=1)
    stretch[:, 2] = np.maximum(stretch[:, 2], np.minimum(thinnest / splats.scales[:, 2], 1))
    axes[:, :, 0] *= np.sign(np.linalg.det(axes))[:, None]  # a rotation
    return replace(
        splats,
        scales=(splats.scales * stretch).astype(np.float32),
        quats=np.ascontiguousarray(Rotation.from_matrix(axes).as_quat(scalar_first=True), np.float32),
        density=(splats.density / stretch.prod(axis=1)).astype(np.float32),
    )


def _structure(volume: Floats, grid: VolumeGrid, sigma: float, points: Floats) -> Array:
    """The structure tensor at points [n, 3] in mm: products of slopes, averaged over `sigma` mm. [n, 3, 3] x y z"""
    voxel = np.array(grid.voxel_mm)
    indices = (points - np.array(grid.center_mm))[:, ::-1] / voxel + (np.array(grid.shape) - 1) / 2
    slopes = [
        ndimage.gaussian_filter(volume, _SMOOTHED, order=np.equal(range(3), axis).astype(int)) / step
        for axis, step in zip((2, 1, 0), grid.voxel_mm[::-1], strict=True)
    ]
    tensor = np.empty((len(points), 3, 3))
    for i in range(3):
        for j in range(i, 3):
            mean = ndimage.gaussian_filter(slopes[i] * slopes[j], sigma / voxel)
            tensor[:, i, j] = tensor[:, j, i] = ndimage.map_coordinates(mean, indices.T, order=1, mode="nearest")
    return tensor
