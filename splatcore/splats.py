"""The volume as Gaussians: means, scales, orientations, densities; and what moves them all at once."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from splatcore.geometry import Array, quaternion_from_rotation
from splatcore.grid import VolumeGrid

Floats = NDArray[np.float32]


@dataclass(frozen=True)
class Splats:
    """density * exp(-|diag(1/scale) R(quat)' (x - mean)|^2 / 2), summed over all splats. float32."""

    means: Floats  # [n, 3] mm
    scales: Floats  # [n, 3] mm, one standard deviation along each own axis
    quats: Floats  # [n, 4] w x y z, unit length not required
    density: Floats  # [n] 1/mm

    def __len__(self) -> int:
        return len(self.means)

    def arrays(self) -> tuple[Floats, Floats, Floats, Floats]:
        return self.means, self.scales, self.quats, self.density

    def zeros_like(self) -> Splats:
        return Splats(*(np.zeros_like(array) for array in self.arrays()))

    def voxelize(self, grid: VolumeGrid, threads: int) -> Floats:
        """The density at the voxel centres of a grid, [z, y, x] 1/mm."""
        from splatcore import _native

        volume = np.empty(grid.shape, np.float32)
        _native.voxelize(grid_array(grid), *self.arrays(), volume, threads)
        return volume

    def moved(self, similarity: Similarity) -> Splats:
        """The same object after x -> scale * rotation x + translation. Density falls as 1/scale, so
        that line integrals through corresponding rays stay what they were."""
        turn = similarity.rotation
        means = similarity.scale * (self.means.astype(np.float64) @ turn.T) + similarity.translation
        return replace(
            self,
            means=means.astype(np.float32),
            scales=(self.scales * similarity.scale).astype(np.float32),
            quats=_multiply(quaternion_from_rotation(turn), self.quats.astype(np.float64)).astype(np.float32),
            density=(self.density / similarity.scale).astype(np.float32),
        )


@dataclass(frozen=True)
class Similarity:
    """x -> scale * rotation x + translation, of the whole world."""

    rotation: Array  # [3, 3]
    translation: Array  # [3] mm
    scale: float = 1.0


def grid_array(grid: VolumeGrid) -> Array:
    """[2, 3]: voxel [z, y, x] mm, centre [x, y, z] mm, as the core takes it."""
    return np.array([grid.voxel_mm, grid.center_mm], np.float64)


def _multiply(left: Array, right: Array) -> Array:
    """Hamilton product of one quaternion with many [n, 4]."""
    w, v = left[0], left[1:]
    scalar = w * right[:, :1] - right[:, 1:] @ v[:, None]
    return np.concatenate([scalar, w * right[:, 1:] + right[:, :1] * v + np.cross(v, right[:, 1:])], axis=1)
