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
    """Splats flattened and stretched after the faces of `volume` [z, y, x] in 1/mm; each keeps its integral. None gets
    thinner than `thinnest` mm.

    They come round in voxels, that is with axes along x, y and z, and as long as voxels are. Faces are looked for in
    lengths in which they are round. Of a grid that is one voxel thick they stay as they are.
    """
    top = float(np.percentile(volume, 99.9))
    if 1 in grid.shape or not top > 0:
        return splats
    usual = np.median(splats.scales, axis=0).astype(np.float64)  # x y z
    sigma = float(usual.min())
    voxel_mm = usual / sigma  # of the new lengths, in mm
    values, axes = np.linalg.eigh(_structure(volume / np.float32(top), grid, voxel_mm, sigma, splats.means))
    least, middle, most = np.maximum(values.T, 0)
    face = np.minimum(np.sqrt(most) * sigma / _FACE, 1)  # how steep
    flatness = face * (most - middle) / np.maximum(most, 1e-30)  # 0: as steep along another axis
    length = face * (most - least) / np.maximum(most, 1e-30)
    stretch = np.stack([1 + (_ALONG - 1) * length, 1 + (_ALONG - 1) * flatness, 1 - (1 - _ACROSS) * flatness], axis=1)
    half_axes = voxel_mm[:, None] * axes * (splats.scales / voxel_mm * stretch)[:, None, :]  # columns, mm
    axes, scales, _ = np.linalg.svd(half_axes)
    scales = np.maximum(scales, np.minimum(thinnest, splats.scales.min(axis=1, keepdims=True)))
    axes[:, :, 0] *= np.sign(np.linalg.det(axes))[:, None]  # a rotation
    return replace(
        splats,
        scales=scales.astype(np.float32),
        quats=np.ascontiguousarray(Rotation.from_matrix(axes).as_quat(scalar_first=True), np.float32),
        density=(splats.density * (splats.scales.prod(axis=1) / scales.prod(axis=1))).astype(np.float32),
    )


def _structure(volume: Floats, grid: VolumeGrid, unit: Array, sigma: float, points: Floats) -> Array:
    """The structure tensor at points [n, 3] in mm: products of slopes, averaged over `sigma`. [n, 3, 3] x y z

    unit [3]: of the lengths along x, y and z in which slopes are taken and sigma is given, in mm.
    """
    voxel = np.array(grid.voxel_mm)
    indices = (points - np.array(grid.center_mm))[:, ::-1] / voxel + (np.array(grid.shape) - 1) / 2
    voxel = voxel / unit[::-1]
    slopes = [
        ndimage.gaussian_filter(volume, _SMOOTHED, order=np.equal(range(3), axis).astype(int)) / voxel[axis]
        for axis in (2, 1, 0)
    ]
    tensor = np.empty((len(points), 3, 3))
    for i in range(3):
        for j in range(i, 3):
            mean = ndimage.gaussian_filter(slopes[i] * slopes[j], sigma / voxel)
            tensor[:, i, j] = tensor[:, j, i] = ndimage.map_coordinates(mean, indices.T, order=1, mode="nearest")
    return tensor
