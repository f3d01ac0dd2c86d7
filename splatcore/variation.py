"""R2-Gaussian's regulariser: the total variation of a small box of the volume, another box at every step.

The variation is anisotropic: the mean absolute difference of neighbouring voxels along the three axes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from splatcore import _native
from splatcore.grid import VolumeGrid
from splatcore.splats import Splats, grid_array

BOX = 32  # voxels an edge, as R2-Gaussian has it


@dataclass
class Variation:
    """The term `weight * total_variation` of a random box of the grid's own voxels."""

    grid: VolumeGrid
    weight: float
    threads: int
    box: int = BOX  # voxels an edge

    def __post_init__(self) -> None:
        nz, ny, nx = (min(self.box, n) for n in self.grid.shape)
        self._shape = (nz, ny, nx)
        self._volume, self._slope = np.empty(self._shape, np.float32), np.empty(self._shape, np.float32)
        self._half = np.array(self._shape[::-1]) * np.array(self.grid.voxel_mm[::-1]) / 2  # x y z

    def add_gradient(self, splats: Splats, gradient: Splats, rng: np.random.Generator) -> float:
        """Add dL/dsplats of the term to `gradient`; returns the term. Splats that do not reach the box are left out."""
        x, y, z = self.grid.center_mm + (self.grid.half_extent_mm() - self._half) * rng.uniform(-1, 1, 3)
        near = np.flatnonzero(self._reaches(splats, (x, y, z)))
        if not near.size:
            return 0.0
        box = grid_array(VolumeGrid(self._shape, self.grid.voxel_mm, (x, y, z)))
        some = Splats(*(array[near] for array in splats.arrays()))
        _native.voxelize(box, *some.arrays(), self._volume, self.threads)
        value = _native.total_variation(self._volume, self._slope, self.threads)
        self._slope *= np.float32(self.weight)
        partial = some.zeros_like()
        _native.voxelize_vjp(box, *some.arrays(), self._slope, *partial.arrays(), self.threads)
        for whole, part in zip(gradient.arrays(), partial.arrays(), strict=True):
            whole[near] += part
        return self.weight * value

    def _reaches(self, splats: Splats, middle: tuple[float, float, float]) -> NDArray[np.bool_]:
        """Which splats come within four standard deviations, where the core ends them, of the box. By columns:
        numpy is slow along short rows."""
        scales, near = splats.scales, np.ones(len(splats), bool)
        reach = 4 * np.maximum(np.maximum(scales[:, 0], scales[:, 1]), scales[:, 2])
        for axis in range(3):
            near &= np.abs(splats.means[:, axis] - np.float32(middle[axis])) < reach + np.float32(self._half[axis])
        return near
