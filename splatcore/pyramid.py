"""The scan at one resolution: images binned by a whole factor (an exact low-pass), frames and grid to match."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from splatcore.geometry import Frames
from splatcore.grid import VolumeGrid
from splatcore.scan import Scan
from splatcore.splats import Floats

_FEWEST_PIXELS = 24  # a level whose detector is smaller than this tells nothing
_FACTORS = (8, 4, 2, 1)


@dataclass(frozen=True)
class Level:
    """One resolution of a scan."""

    factor: int
    nominal: Frames
    images: Floats  # [views, rows, cols]
    mask: Floats | None  # [rows, cols] share of good pixels, None where all are good
    grid: VolumeGrid

    @property
    def voxel_mm(self) -> float:
        """Edge of a cube as large as the grid's voxel."""
        return math.prod(self.grid.voxel_mm) ** (1 / 3)

    @property
    def pixel_at_isocentre_mm(self) -> float:
        """A detector pixel seen at the isocentre, the smaller of its sides, median over views."""
        step = np.minimum(np.linalg.norm(self.nominal.u, axis=1), np.linalg.norm(self.nominal.v, axis=1))
        return float(np.median(step * self.nominal.isocentre_depth()))


def factors(scan: Scan, finest: int) -> list[int]:
    """Binning factors from coarse to `finest`, leaving out those too coarse for this detector."""
    least = min(scan.frames.rows, scan.frames.cols)
    usable = [f for f in _FACTORS if f >= finest and least // f >= _FEWEST_PIXELS]
    return usable or [1]


def level(scan: Scan, factor: int) -> Level:
    """The scan binned by `factor`, on a grid whose voxels are as many times larger."""
    frames, grid = scan.frames.binned(factor), scan.volume
    mask = None if scan.bad_pixels is None else _bin((~scan.bad_pixels).astype(np.float32)[None], factor)[0]
    coarse = VolumeGrid(
        (-(-grid.shape[0] // factor), -(-grid.shape[1] // factor), -(-grid.shape[2] // factor)),
        (grid.voxel_mm[0] * factor, grid.voxel_mm[1] * factor, grid.voxel_mm[2] * factor),
        grid.center_mm,
    )
    return Level(factor, frames, _bin(scan.projections, factor), mask, coarse)


def _bin(images: Floats, factor: int) -> Floats:
    """Means of factor x factor blocks; rows and columns that fill no block are dropped."""
    if factor == 1:
        return np.ascontiguousarray(images, np.float32)
    views, rows, cols = images.shape[0], images.shape[1] // factor, images.shape[2] // factor
    cut = images[:, : rows * factor, : cols * factor]
    return np.ascontiguousarray(cut.reshape(views, rows, factor, cols, factor).mean(axis=(2, 4)), np.float32)
