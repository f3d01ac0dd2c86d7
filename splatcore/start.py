"""A first volume from projections (FDK for arbitrary frames) and first splats from a volume."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy import fft, ndimage

from splatcore import _native
from splatcore.errors import ReconstructionError
from splatcore.geometry import Array, Frames
from splatcore.grid import VolumeGrid
from splatcore.redundancy import coverage, ray_weights
from splatcore.splats import Floats, Splats, grid_array

_SHARE_OF_END = 50  # the level at the end of a row is the mean over this part of it
_ABOVE_AIR, _ENOUGH = 0.05, 0.02  # of the largest line integral; share of a row's end that must exceed it
_COUNTS = 0.1  # of a view's largest ray weight
_SEEN = 0.9  # of all directions
_SIGMA = 0.55  # of a splat, of the edge of the cube that it stands for
_EMPTY = 0.01  # of the 99.9th percentile of the level above: what is more is solid
_SPARSE = 2.0  # times the lattice's pitch elsewhere


def fdk(projections: Floats, frames: Frames, grid: VolumeGrid, threads: int, hann: float = 1.0) -> Floats:
    """Filtered backprojection after Feldkamp, Davis and Kress (1984), each view with its own frame.

    projections [views, rows, cols], bad pixels filled; hann: cut-off of the window on the ramp, as a share of
    Nyquist (0: no window). Returns [z, y, x] 1/mm. Views count by the angle they stand for, rays by how often they
    are seen (splatcore.redundancy); rows that end inside the object are continued beyond the detector.
    """
    frames, projections = _rows_across_axis(frames, projections)
    volume = np.zeros(grid.shape, np.float32)
    box, packed = grid_array(grid), frames.packed()
    weights = ray_weights(frames)
    for k in range(len(frames)):
        filtered = _filter(projections[k], frames[k : k + 1], weights[k], hann, threads)
        for axis in np.flatnonzero(np.equal(filtered.shape, 1)):  # rounding lifts voxels off an only row or column:
            filtered = np.repeat(filtered, 3, axis=axis)  # the same one on either side catches them
        _native.backproject(packed[k], frames.beam == "cone", box, filtered, 1.0, volume, threads)
    return volume


def _rows_across_axis(frames: Frames, projections: Floats) -> tuple[Frames, Floats]:
    """The views with their rows across the rotation axis, which the ramp must run across: transposed if need be."""
    along_z = [np.abs(step[:, 2]) / np.linalg.norm(step, axis=1) for step in (frames.u, frames.v)]
    if np.median(along_z[0]) <= np.median(along_z[1]):
        return frames, projections
    turned = replace(frames, u=frames.v, v=frames.u, rows=frames.cols, cols=frames.rows)
    return turned, np.ascontiguousarray(projections.transpose(0, 2, 1))


def _filter(image: Floats, frame: Frames, weights: Array, hann: float, threads: int) -> Floats:
    """Cosine and redundancy weights and the ramp along rows, in units such that plain backprojection gives 1/mm."""
    rows, cols = image.shape
    pitch = float(np.linalg.norm(frame.u))
    if frame.beam == "cone":
        column = (np.arange(cols) - (cols - 1) / 2)[None, :, None] * frame.u[0]
        row = (np.arange(rows) - (rows - 1) / 2)[:, None, None] * frame.v[0]
        away = frame.detector_center[0] - frame.source[0] + column + row
        normal = np.cross(frame.u[0], frame.v[0])
        normal /= np.linalg.norm(normal)
        depth = abs(float(normal @ (frame.detector_center[0] - frame.source[0])))
        weights = weights * depth / np.linalg.norm(away, axis=2)
        # The pitch on a detector moved to the isocentre.
        pitch *= abs(float(normal @ frame.source[0])) / depth
    beyond = cols // 4
    length = fft.next_fast_len(2 * (cols + beyond), real=True)
    response = _ramp(length, pitch)
    if hann > 0:
        frequency = np.arange(len(response)) / (length / 2) / hann
        response = np.where(frequency < 1, response * (0.5 + 0.5 * np.cos(np.pi * frequency)), 0)
    continued = _continued(image * weights.astype(np.float32), beyond)
    spectrum = fft.rfft(continued, length, axis=1, workers=threads)
    filtered = fft.irfft(spectrum * response.astype(np.float32), length, axis=1, workers=threads)
    return np.ascontiguousarray(filtered[:, beyond : beyond + cols], np.float32)


def _continued(image: Floats, margin: int) -> Floats:
    """Rows continued by `margin` columns on either side, falling from the level at their ends to zero as cos^2: a
    row cut off inside the object would come out of the ramp with a bright rim. [rows, cols + 2 margin]"""
    cols = image.shape[1]
    end = max(1, min(cols, cols // _SHARE_OF_END))
    fall = np.cos(np.pi / 2 * np.arange(1, margin + 1) / (margin + 1)).astype(np.float32) ** 2
    left, right = (np.maximum(part.mean(axis=1, keepdims=True), 0) for part in (image[:, :end], image[:, -end:]))
    return np.concatenate([left * fall[::-1], image, right * fall], axis=1)


def _ramp(length: int, pitch: float) -> Array:
    """The band-limited ramp of Kak and Slaney (1988, eq. 3.61), sampled in space so that its mean is right."""
    n = np.concatenate([np.arange(length // 2 + 1), np.arange(length // 2 + 1 - length, 0)])
    kernel = np.zeros(length)
    kernel[0] = 1 / (4 * pitch)
    odd = n % 2 == 1
    kernel[odd] = -1 / (np.pi**2 * n[odd].astype(np.float64) ** 2 * pitch)
    return np.real(np.fft.rfft(kernel))


def first_splats(
    images: Floats,
    frames: Frames,
    grid: VolumeGrid,
    count: int,
    rng: np.random.Generator,
    threads: int,
    above: Floats | None = None,
) -> tuple[Splats, float]:
    """(about `count` splats of an FDK volume, the density 1/mm that is typical of what is dense in it).

    above [z, y, x]: the volume of a coarser level, in this grid's voxels. It knows better where the object is.

    Where rows are cut off inside the object, nothing is put where views cannot see all round: what FDK finds there
    is smeared over the whole corner, and splats that start with it hold density back from the inside. The splats at
    the rim reach out for what is missing by themselves."""
    volume = fdk(images, frames, grid, threads)
    solid = None if above is None else ndimage.binary_dilation(above > _EMPTY * np.percentile(above, 99.9))
    if cut_off(images, frames):
        seen = coverage(frames, grid) >= _SEEN
        kept = np.where(seen, volume, 0)
        if np.percentile(kept, 99.9) > 0:  # nothing may be seen all round
            volume, solid = kept, None if solid is None else solid & seen
    return splats_from_volume(volume, grid, count, rng, solid=solid), float(np.percentile(volume, 99.9))


def cut_off(images: Floats, frames: Frames) -> bool:
    """Whether the object reaches an end of the rows, in the direction across the axis."""
    frames, images = _rows_across_axis(frames, images)
    limit = _ABOVE_AIR * float(images.max())
    weights = ray_weights(frames)
    # Of a half fan the end near the axis is always inside the object, and counts for nothing.
    counts = weights / np.maximum(weights.max(axis=1, keepdims=True), 1e-30) > _COUNTS
    return any(
        float((images[:, :, end] > limit).mean(axis=1) @ counted) > _ENOUGH * len(images)
        for end, counted in ((0, counts[:, 0]), (-1, counts[:, -1]))
    )


def splats_from_volume(
    volume: Floats,
    grid: VolumeGrid,
    count: int,
    rng: np.random.Generator,
    threshold: float = 0.05,
    solid: NDArray[np.bool_] | None = None,
) -> Splats:
    """About `count` splats, round in voxels, on a body-centred lattice wherever the volume is not empty.

    threshold: empty is below this share of the volume's 99.9th percentile. The lattice is as fine as it
    can be within `count`, but no finer than the voxels; positions are jittered by a tenth of its pitch.
    solid [z, y, x]: where the object is known to be, whatever the volume shows. What it shows elsewhere is noise and
    streaks; the lattice is twice as coarse there.
    """
    top = float(np.percentile(volume, 99.9))
    if not top > 0:
        raise ReconstructionError(
            "the first backprojection is empty: got no voxel above zero, expected an object inside the "
            "volume; try a larger volume, or check the sign and kind of the projections"
        )
    level = threshold * top
    spread = np.array(volume.shape) > 1  # the axes along which there is a lattice; a single slice has one layer
    dimensions = max(int(spread.sum()), 1)
    finest = 2 ** (1 / dimensions)
    occupied = float(np.count_nonzero(volume > level))
    if solid is not None:
        beyond = np.count_nonzero((volume > level) & ~solid)
        occupied = np.count_nonzero(solid) + beyond / _SPARSE**dimensions
    pitch = (2 * occupied / count) ** (1 / dimensions)  # voxels; two points a cell
    better = pitch
    for _ in range(8):
        pitch = max(float(better), finest)
        points, values, times = _lattices(volume, pitch, level, solid)
        if 0.97 * count <= len(points) <= count or (len(points) < count and pitch <= finest):
            break
        better = pitch * (len(points) / (0.985 * count)) ** (1 / dimensions)
    if len(points) > count:
        keep = np.sort(rng.choice(len(points), count, replace=False))
        points, values, times = points[keep], values[keep], times[keep]
    spacing = times * pitch / finest  # edge of the cube that each splat stands for, voxels
    sigma = _SIGMA * spacing
    sparse = times > 1
    if sparse.any():
        blurred = ndimage.gaussian_filter(volume, 0.8 * sigma[sparse][0] * spread)
        values[sparse] = ndimage.map_coordinates(blurred, points[sparse].T, order=1, mode="nearest")
    values = np.maximum(values, 2e-3 * level)
    points = points + rng.uniform(-0.1, 0.1, points.shape) * (times * pitch)[:, None] * spread
    sharpness = (spacing / (np.sqrt(2 * np.pi) * sigma)) ** dimensions  # overlapping splats add up to the volume
    voxel = np.where(spread, grid.voxel_mm, grid.edge_mm)
    middle = (np.array(grid.shape) - 1) / 2
    zyx = (points - middle) * np.array(grid.voxel_mm)
    means = zyx[:, ::-1] + np.array(grid.center_mm)
    n = len(points)
    return Splats(
        means=np.ascontiguousarray(means, np.float32),
        scales=np.ascontiguousarray(sigma[:, None] * voxel[::-1], np.float32),
        quats=np.tile(np.array([1, 0, 0, 0], np.float32), (n, 1)),
        density=(values * sharpness).astype(np.float32),
    )


def _lattices(
    volume: Floats, pitch: float, level: float, solid: NDArray[np.bool_] | None
) -> tuple[Array, Array, Array]:
    """Points of a lattice where the volume exceeds `level`, or of one in what is solid and a coarser one where the
    volume does so elsewhere; the volume's values at them, and how many times the pitch theirs is."""
    points, values = _lattice(volume, pitch)
    if solid is None:
        kept = values > level
        return points[kept], values[kept], np.ones(np.count_nonzero(kept))
    kept = _at(points, solid)
    there, faint = _lattice(volume, _SPARSE * pitch)
    more = (faint > level) & ~_at(there, solid)
    times = np.repeat([1.0, _SPARSE], [np.count_nonzero(kept), np.count_nonzero(more)])
    return np.concatenate([points[kept], there[more]]), np.concatenate([values[kept], faint[more]]), times


def _at(points: Array, mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The mask's values in the voxels that points [n, 3] lie in."""
    z, y, x = np.clip(np.rint(points).astype(int), 0, np.array(mask.shape) - 1).T
    found: NDArray[np.bool_] = mask[z, y, x]
    return found


def _lattice(volume: Floats, pitch: float) -> tuple[Array, Array]:
    """Points (z, y, x in voxel indices) of a body-centred lattice, and the volume's values at them."""
    found = []
    for shift in (0.25, 0.75):
        axes = [np.arange(shift * pitch - 0.5, n - 0.5, pitch) if n > 1 else np.zeros(1) for n in volume.shape]
        found.append(np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3))
    points = np.concatenate(found)
    return points, ndimage.map_coordinates(volume, points.T, order=1, mode="nearest").astype(np.float64)
