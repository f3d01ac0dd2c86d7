"""A first volume from projections (FDK for arbitrary frames) and first splats from a volume."""

from __future__ import annotations

import numpy as np
from scipy import fft, ndimage

from splatcore import _native
from splatcore.errors import ReconstructionError
from splatcore.geometry import Array, Frames
from splatcore.grid import VolumeGrid
from splatcore.splats import Floats, Splats, grid_array

_SAME_ANGLE = np.deg2rad(1e-3)  # views closer than this stand at one angle


def fdk(projections: Floats, frames: Frames, grid: VolumeGrid, threads: int, hann: float = 1.0) -> Floats:
    """Filtered backprojection after Feldkamp, Davis and Kress (1984), each view with its own frame.

    projections [views, rows, cols]; hann: cut-off of the window on the ramp, as a share of Nyquist
    (0: no window). Returns [z, y, x] 1/mm. Views are weighted by the angle each stands for.
    """
    volume = np.zeros(grid.shape, np.float32)
    box, packed = grid_array(grid), frames.packed()
    weights = angular_weights(frames)
    for k in range(len(frames)):
        filtered = _filter(projections[k], frames[k : k + 1], hann, threads)
        _native.backproject(packed[k], frames.beam == "cone", box, filtered, float(weights[k]), volume, threads)
    return volume


def angular_weights(frames: Frames) -> Array:
    """Half the angle to the two neighbours on the orbit, in radians, times 1/2 for the circle's two-fold
    cover: sum pi over a full circle. Gaps beyond three times the median are the ends of a short scan. [views]"""
    outward = frames.source if frames.beam == "cone" else -frames.source
    angle = np.arctan2(outward[:, 1], outward[:, 0])
    order = np.argsort(angle)
    gaps = np.diff(angle[order], append=angle[order[0]] + 2 * np.pi)
    apart = gaps[gaps > _SAME_ANGLE]  # a scan of several turns sees every angle more than once
    usual = float(np.median(apart if apart.size else gaps))
    gaps = np.where(gaps > 3 * usual, usual, gaps)
    weights = np.empty(len(angle))
    weights[order] = (gaps + np.roll(gaps, 1)) / 2
    covered = float(gaps.sum())
    # A full circle sees every ray twice; an arc near a half circle sees it about once.
    return weights * (0.5 if covered > 1.5 * np.pi else np.pi / max(covered, 1e-9))


def _filter(image: Floats, frame: Frames, hann: float, threads: int) -> Floats:
    """Cosine weight and ramp along the rows, in units such that plain backprojection gives 1/mm."""
    rows, cols = image.shape
    pitch = float(np.linalg.norm(frame.u))
    if frame.beam == "cone":
        column = (np.arange(cols) - (cols - 1) / 2)[None, :, None] * frame.u[0]
        row = (np.arange(rows) - (rows - 1) / 2)[:, None, None] * frame.v[0]
        away = frame.detector_center[0] - frame.source[0] + column + row
        normal = np.cross(frame.u[0], frame.v[0])
        normal /= np.linalg.norm(normal)
        depth = abs(float(normal @ (frame.detector_center[0] - frame.source[0])))
        image = image * (depth / np.linalg.norm(away, axis=2)).astype(np.float32)
        # The pitch on a detector moved to the isocentre.
        pitch *= abs(float(normal @ frame.source[0])) / depth
    length = fft.next_fast_len(2 * cols, real=True)
    response = _ramp(length, pitch)
    if hann > 0:
        frequency = np.arange(len(response)) / (length / 2) / hann
        response = np.where(frequency < 1, response * (0.5 + 0.5 * np.cos(np.pi * frequency)), 0)
    spectrum = fft.rfft(image, length, axis=1, workers=threads)
    filtered = fft.irfft(spectrum * response.astype(np.float32), length, axis=1, workers=threads)
    return np.ascontiguousarray(filtered[:, :cols], np.float32)


def _ramp(length: int, pitch: float) -> Array:
    """The band-limited ramp of Kak and Slaney (1988, eq. 3.61), sampled in space so that its mean is right."""
    n = np.concatenate([np.arange(length // 2 + 1), np.arange(length // 2 + 1 - length, 0)])
    kernel = np.zeros(length)
    kernel[0] = 1 / (4 * pitch)
    odd = n % 2 == 1
    kernel[odd] = -1 / (np.pi**2 * n[odd].astype(np.float64) ** 2 * pitch)
    return np.real(np.fft.rfft(kernel))


def splats_from_volume(
    volume: Floats, grid: VolumeGrid, count: int, rng: np.random.Generator, threshold: float = 0.05
) -> Splats:
    """About `count` isotropic splats on a body-centred lattice wherever the volume is not empty.

    threshold: empty is below this share of the volume's 99.9th percentile. The lattice is as fine as it
    can be within `count`, but no finer than the voxels; positions are jittered by a tenth of its pitch.
    """
    top = float(np.percentile(volume, 99.9))
    if not top > 0:
        raise ReconstructionError(
            "the first backprojection is empty: got no voxel above zero, expected an object inside the "
            "volume; try a larger volume, or check the sign and kind of the projections"
        )
    level = threshold * top
    occupied = int(np.count_nonzero(volume > level))
    pitch = (2 * occupied / count) ** (1 / 3)  # voxels; two points a cell
    for _ in range(8):
        pitch = max(pitch, 2 ** (1 / 3))
        points, values = _lattice(volume, pitch, level)
        if 0.97 * count <= len(points) <= count or (len(points) < count and pitch <= 2 ** (1 / 3)):
            break
        pitch *= (len(points) / (0.985 * count)) ** (1 / 3)
    if len(points) > count:
        keep = np.sort(rng.choice(len(points), count, replace=False))
        points, values = points[keep], values[keep]
    points = points + rng.uniform(-0.1, 0.1, points.shape) * pitch
    spacing = pitch / 2 ** (1 / 3)  # edge of the cube that each splat stands for, voxels
    voxel = float(np.prod(grid.voxel_mm)) ** (1 / 3)
    sigma = 0.55 * spacing
    sharpness = spacing**3 / ((2 * np.pi) ** 1.5 * sigma**3)  # so that overlapping splats add up to the volume
    middle = (np.array(grid.shape) - 1) / 2
    zyx = (points - middle) * np.array(grid.voxel_mm)
    means = zyx[:, ::-1] + np.array(grid.center_mm)
    n = len(points)
    return Splats(
        means=np.ascontiguousarray(means, np.float32),
        scales=np.full((n, 3), sigma * voxel, np.float32),
        quats=np.tile(np.array([1, 0, 0, 0], np.float32), (n, 1)),
        density=(values * sharpness).astype(np.float32),
    )


def _lattice(volume: Floats, pitch: float, level: float) -> tuple[Array, Array]:
    """Points (z, y, x in voxel indices) of a body-centred lattice where the volume exceeds `level`, and its values."""
    found = []
    for shift in (0.25, 0.75):
        axes = [np.arange(shift * pitch - 0.5, n - 0.5, pitch) for n in volume.shape]
        points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
        values = ndimage.map_coordinates(volume, points.T, order=1, mode="nearest")
        keep = values > level
        found.append((points[keep], values[keep]))
    return np.concatenate([p for p, _ in found]), np.concatenate([v for _, v in found]).astype(np.float64)
