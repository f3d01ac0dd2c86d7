"""The voxel grid of a volume: where every voxel's centre lies.

Arrays of voxels are [z, y, x]; so are `shape` and `voxel_mm`. Points are (x, y, z), and so is `center_mm`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from splatcore.errors import Problem, ScanError
from splatcore.geometry import Array, Frames


@dataclass(frozen=True)
class VolumeGrid:
    """Voxel (k, j, i) has its centre at x = (i + 1/2) vx - Lx/2 + center_mm[0], and so on."""

    shape: tuple[int, int, int]  # [z, y, x]
    voxel_mm: tuple[float, float, float]  # [z, y, x]
    center_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)  # (x, y, z) of the volume's middle

    @property
    def voxels(self) -> int:
        return math.prod(self.shape)

    @property
    def edge_mm(self) -> float:
        """Edge of a cube as large as a voxel; of a grid that is one voxel thick, of a square."""
        steps = [step for n, step in zip(self.shape, self.voxel_mm, strict=True) if n > 1] or list(self.voxel_mm)
        return float(math.prod(steps) ** (1 / len(steps)))

    def half_extent_mm(self) -> Array:
        """Half the volume's width along x, y, z. [3]"""
        return np.array([n * step / 2 for n, step in zip(self.shape[::-1], self.voxel_mm[::-1], strict=True)])

    def axes_mm(self) -> tuple[Array, Array, Array]:
        """Voxel centre coordinates along x, y and z. [nx], [ny], [nz]"""
        x, y, z = (
            (np.arange(n, dtype=np.float64) - (n - 1) / 2) * step + middle
            for n, step, middle in zip(self.shape[::-1], self.voxel_mm[::-1], self.center_mm, strict=True)
        )
        return x, y, z

    def centers_mm(self) -> Array:
        """Every voxel's centre (x, y, z). [z, y, x, 3]"""
        x, y, z = self.axes_mm()
        zz, yy, xx = np.meshgrid(z, y, x, indexing="ij")
        return np.stack([xx, yy, zz], axis=-1)

    def to_json(self) -> dict[str, Any]:
        return {"shape": list(self.shape), "voxel_mm": list(self.voxel_mm), "center_mm": list(self.center_mm)}


_MOST_DERIVED_VOXELS = 512**3


def _underivable(why: str) -> Problem:
    return Problem("/volume", f"is left out and cannot be derived from the views: {why}", "give shape and voxel_mm")


def grid_from_view(frames: Frames) -> VolumeGrid:
    """The cube-voxelled grid around the rotation axis that the views see: the field of view's width across,
    its height at the axis along z, the voxel as large as a pixel seen at the isocentre (larger where that
    would exceed 512^3 voxels).

    Raises ScanError where the isocentre does not lie before the sources, or rays run along the axis."""
    cone = frames.beam == "cone"
    isocentre = np.zeros((1, 3))
    middle = frames.pixel_from_world() @ -frames.origin()[..., None]  # [views, 3, 1]
    with np.errstate(divide="ignore", invalid="ignore"):
        projected = frames.project(isocentre)
    column, row = projected[:, 0].T - np.array([[(frames.cols - 1) / 2], [(frames.rows - 1) / 2]])
    depth = middle[:, 2, 0] if cone else np.ones(len(frames))
    if depth.min() < 1e-6:
        raise ScanError([_underivable("the isocentre (0, 0, 0) does not lie before the source in every view")])
    pixel = np.sqrt(np.linalg.norm(frames.u, axis=1) * np.linalg.norm(frames.v, axis=1)) * depth
    voxel = float(np.median(pixel))

    def ray(columns: Array, rows: Array) -> tuple[Array, Array]:
        """A point and a unit direction of the rays through detector positions counted from the middle."""
        point = frames.detector_center + columns[:, None] * frames.u + rows[:, None] * frames.v
        along = point - frames.source if cone else frames.source
        return point, along / np.linalg.norm(along, axis=1, keepdims=True)

    reach = []  # distance of the isocentre from the outermost rays, per side and view
    for edge in (-frames.cols / 2, frames.cols / 2):
        point, along = ray(np.full_like(row, edge), row)
        reach.append(np.linalg.norm(np.cross(point, along), axis=1))
    radius = float(np.median(np.max(reach, axis=0)))

    heights = []  # z where the uppermost and lowest rays pass closest to the axis
    for edge in (-frames.rows / 2, frames.rows / 2):
        point, along = ray(column, np.full_like(column, edge))
        flat = np.sum(along[:, :2] ** 2, axis=1)
        if flat.min() < 0.01:
            raise ScanError([_underivable("rays run along the rotation axis z")])
        heights.append(point[:, 2] - np.sum(point[:, :2] * along[:, :2], axis=1) / flat * along[:, 2])
    low, high = float(np.min(heights)), float(np.max(heights))

    fill = 4 * radius**2 * max(high - low, voxel) / voxel**3
    voxel *= max(1.0, (fill / _MOST_DERIVED_VOXELS) ** (1 / 3))
    across = max(1, math.floor(2 * radius / voxel + 1e-6))
    along_z = max(1, math.floor((high - low) / voxel + 1e-6))
    return VolumeGrid((along_z, across, across), (voxel,) * 3, (0.0, 0.0, (low + high) / 2))
