"""How like the truth a volume is: PSNR and SSIM, by R2-Gaussian's rules.

Volumes are [z, y, x] in 1/mm; both are divided by `unit`, the attenuation that counts as 1 (the scan's
`attenuation_unit`), never by their maximum. All voxels count, nothing is clipped or masked.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Doubles = NDArray[np.float64]

_WINDOW, _SIGMA = 11, 1.5
_C1, _C2 = 0.01**2, 0.03**2  # data range 1
_CHUNK = 2**21  # voxels handled at once


def psnr(volume: ArrayLike, truth: ArrayLike, unit: float = 1.0) -> float:
    """10 log10(1 / MSE) in dB; infinite where the two are equal."""
    ours, theirs = _pair(volume, truth)
    difference = np.subtract(ours, theirs, dtype=np.float64) / unit
    mse = float(np.mean(np.square(difference, out=difference)))
    return 10 * float(np.log10(1 / mse)) if mse > 0 else float("inf")


def ssim(volume: ArrayLike, truth: ArrayLike, unit: float = 1.0) -> float:
    """Mean structural similarity of 2-D slices: the mean across each axis, then the mean of the three.

    Slices whose truth is all zero are left out; nan if the whole truth is zero."""
    ours, theirs = _pair(volume, truth)
    if not theirs.any():
        return float("nan")
    return float(np.mean([_ssim_across(np.moveaxis(ours, a, 0), np.moveaxis(theirs, a, 0), unit) for a in range(3)]))


def _pair(volume: ArrayLike, truth: ArrayLike) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
    ours, theirs = np.asarray(volume), np.asarray(truth)
    if ours.ndim != 3 or ours.shape != theirs.shape:
        raise ValueError(f"got volumes of shape {ours.shape} and {theirs.shape}, expected two alike [z, y, x]")
    return ours, theirs


def _ssim_across(ours: NDArray[np.floating], theirs: NDArray[np.floating], unit: float) -> float:
    """Mean SSIM of slices [n, rows, cols] whose truth is not all zero."""
    kept = np.flatnonzero(theirs.any(axis=(1, 2)))
    at_once = max(1, _CHUNK // theirs[0].size)
    total = 0.0
    for first in range(0, len(kept), at_once):
        some = kept[first : first + at_once]
        x, y = ours[some].astype(np.float64) / unit, theirs[some].astype(np.float64) / unit
        total += float(np.sum(np.mean(_ssim_map(x, y), axis=(1, 2))))
    return total / len(kept)


def _ssim_map(x: Doubles, y: Doubles) -> Doubles:
    """SSIM at every pixel of slices. [n, rows, cols]"""
    mean_x, mean_y = _blur(x), _blur(y)
    xx, yy, xy = mean_x * mean_x, mean_y * mean_y, mean_x * mean_y
    var_x, var_y, cov = _blur(x * x) - xx, _blur(y * y) - yy, _blur(x * y) - xy
    result: Doubles = (2 * xy + _C1) * (2 * cov + _C2) / ((xx + yy + _C1) * (var_x + var_y + _C2))
    return result


def _blur(slices: Doubles) -> Doubles:
    """Every slice under the Gaussian window, zeros beyond its edge. [n, rows, cols]"""
    from scipy.ndimage import correlate1d

    offsets = np.arange(_WINDOW) - _WINDOW // 2
    kernel = np.exp(-(offsets**2) / (2 * _SIGMA**2))
    kernel /= kernel.sum()
    for axis in (1, 2):
        slices = correlate1d(slices, kernel, axis=axis, mode="constant")
    return slices
