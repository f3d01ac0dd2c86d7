"""The scan at one resolution: images binned by a whole factor (an exact low-pass), frames and grid to match."""

from __future__ import annotations

from dataclasses import dataclass
from functools import reduce

import numpy as np

from splatcore.geometry import Frames
from splatcore.grid import VolumeGrid
from splatcore.scan import Scan
from splatcore.splats import Floats

_FEWEST_PIXELS = 24  # a side of a level's detector that is shorter than this is no longer binned
_FACTORS = (8, 4, 2, 1)
_STRIDED = 4  # pixels along a side of a block up to which its lines are added one by one: numpy's order, much faster
_THINNEST, _WIDEST = 0.3, 20.0  # standard deviations of a splat, voxels


@dataclass(frozen=True)
class Level:
    """One resolution of a scan."""

    factor: int
    binning: tuple[int, int]  # rows, columns in a block: the factor, or less along a short side
    nominal: Frames
    images: Floats  # [views, rows, cols]
    mask: Floats | None  # [rows, cols] share of good pixels, None where all are good
    grid: VolumeGrid

    @property
    def voxel_mm(self) -> float:
        """Edge of a cube (one slice of voxels: of a square) as large as the grid's voxel."""
        return self.grid.edge_mm

    @property
    def scale_limits(self) -> tuple[float, float]:
        """The smallest and largest standard deviation of a splat, mm: voxels do not show what is thinner."""
        sides = [side for side, count in zip(self.grid.voxel_mm, self.grid.shape, strict=True) if count > 1]
        return _THINNEST * min(sides or self.grid.voxel_mm), _WIDEST * self.voxel_mm

    @property
    def pixel_at_isocentre_mm(self) -> float:
        """A detector pixel seen at the isocentre, the smaller of its sides, median over views."""
        step = np.minimum(np.linalg.norm(self.nominal.u, axis=1), np.linalg.norm(self.nominal.v, axis=1))
        if self.nominal.line:  # the side across the line is not seen
            step = np.linalg.norm(self.nominal.u if self.nominal.rows == 1 else self.nominal.v, axis=1)
        return float(np.median(step * self.nominal.isocentre_depth()))

    def binned(self, frames: Frames) -> Frames:
        """Frames of the whole detector as this level's images have them."""
        return frames.binned(*self.binning)


def factors(scan: Scan, finest: int) -> list[int]:
    """Binning factors from coarse to `finest`, leaving out those too coarse for this detector's longer side."""
    most = max(scan.frames.rows, scan.frames.cols)
    usable = [f for f in _FACTORS if f >= finest and most // f >= _FEWEST_PIXELS]
    return usable or [1]


def level(scan: Scan, factor: int) -> Level:
    """The scan binned by `factor`, on a grid whose voxels are as many times larger. A detector's short side, a few
    rows or a single one, is binned by less, so that no less than 24 pixels are left where there were as many."""
    binning = (_factor_of(scan.frames.rows, factor), _factor_of(scan.frames.cols, factor))
    good = None if scan.bad_pixels is None else (~scan.bad_pixels).astype(np.float32)
    mask = None if good is None else means_of_blocks(good[None], binning)[0]
    return Level(
        factor, binning, scan.frames.binned(*binning), means_of_blocks(scan.projections, binning, good), mask,
        coarser(scan.volume, factor),
    )  # fmt: skip


def coarser(grid: VolumeGrid, factor: int) -> VolumeGrid:
    """The grid whose voxels are so many times larger. A single slice stays as thick as it is."""
    nz, ny, nx = grid.shape
    down = (1 if nz == 1 else factor, 1 if ny == 1 else factor, 1 if nx == 1 else factor)
    vz, vy, vx = grid.voxel_mm
    shape = (-(-nz // down[0]), -(-ny // down[1]), -(-nx // down[2]))
    return VolumeGrid(shape, (vz * down[0], vy * down[1], vx * down[2]), grid.center_mm)


def _factor_of(side: int, factor: int) -> int:
    """The largest factor up to `factor` that leaves 24 pixels of a side, or 1."""
    return next(f for f in _FACTORS if f == 1 or (f <= factor and side // f >= _FEWEST_PIXELS))


def means_of_blocks(images: Floats, binning: tuple[int, int], good: Floats | None = None) -> Floats:
    """Means of blocks, of their good pixels where there are any; rows and columns that fill no block are dropped."""
    down, across = binning
    if binning == (1, 1):
        return np.ascontiguousarray(images, np.float32)
    views, rows, cols = images.shape[0], images.shape[1] // down, images.shape[2] // across
    images = images[:, : rows * down, : cols * across]
    cut = images.reshape(views, rows, down, cols, across)
    if max(binning) <= _STRIDED:
        means = np.empty((views, rows, cols), np.float32)
        for image, mean in zip(images, means, strict=True):
            lines = (reduce(np.add, (image[i::down, j::across] for j in range(across))) for i in range(down))
            np.divide(reduce(np.add, lines), np.float32(down * across), out=mean)
    else:
        means = np.ascontiguousarray(cut.mean(axis=(2, 4)), np.float32)
    if good is None or good.all():
        return means
    weight = good[: rows * down, : cols * across].reshape(rows, down, cols, across)
    # Only blocks with a bad pixel in them: the others keep the bits that they have without a mask.
    r, c = np.nonzero((weight.min(axis=(1, 3)) < 1) & (weight.max(axis=(1, 3)) > 0))
    blocks = weight[r, :, c]  # [blocks, down, across]
    sums = np.einsum("bvij,bij->vb", cut[:, r, :, c], blocks)
    means[:, r, c] = sums / blocks.sum(axis=(1, 2))
    return means
