"""The finest level as the poses are to see it: residuals at the resolution that the splats have.

What a residual holds beyond that is the model's own error, largest where a view looks along a flat face, and it
drags the view there by several times its standard deviation. Noise beyond that says nothing about a pose: at such
frequencies a view shares too few coefficients with the others (docs/method/uncertainty.md).

An edge of splats is softer than the object's, too, and a view along a face can make it sharper by turning. So the
poses see no part of a residual that a sharper or softer image of the same splats would explain.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage

from splatcore import _native
from splatcore.geometry import Array, Frames
from splatcore.pyramid import Level, means_of_blocks
from splatcore.splats import Floats, Splats
from splatcore.uncertainty import extent

NORMAL = 1.2533  # standard deviation over mean absolute deviation, of normal noise
HUBER = 2.0  # standard deviations of the residual beyond which a pixel counts less for the poses
_TAILS = 3.0  # standard deviations at which the filter's kernel ends
_BINNING = 2
_SPLATS = 1.5  # largest width of the filter, in sizes of the median splat
_SHARED = 0.25  # and in wavelengths of the finest detail that views share: it passes half at three quarters of that
_TILE = 16  # binned pixels along a side, of the pieces of a view that may each be blurred by an amount of their own
_BLUR = 0.03  # expected size of these amounts, where nothing is seen of them; half a squared binned pixel
_LEAST = 1.0  # pixels; a filter that would be narrower is left out


@dataclass(frozen=True)
class LowPassed:
    """A level whose images differ from the splats' by the low-pass of what they differed by before."""

    here: Level
    renderer: _native.Renderer32  # of its detector
    shared: float  # pixels whose noise is as good as one independent measurement
    rough: float  # mean absolute residual before, line integral
    smooth: float  # and after


def low_passed(
    here: Level,
    frames: Frames,
    renderer: _native.Renderer32,
    splats: Splats,
    threads: int,
    excess: Callable[[int, Floats], Floats] | None = None,
) -> LowPassed | None:
    """The level, binned by two and filtered by a Gaussian, as `splats` leave it at the corrected `frames`; None where
    splats, or the detail that views share, are as fine as pixels.

    excess: what the images of a view, drawn as given, hold in the mean beyond it (splatcore.clipping)."""
    size = _width(splats, len(frames))
    binning = (_BINNING if frames.rows > 1 else 1, _BINNING if frames.cols > 1 else 1)
    small = frames.binned(*binning)
    depth = frames.isocentre_depth()
    pitch = [float(np.median(np.linalg.norm(side, axis=1) * depth)) for side in (small.v, small.u)]
    sigmas = [size / side if down > 1 else 0.0 for side, down in zip(pitch, binning, strict=True)]  # binned pixels
    if max(sigmas) < _LEAST / _BINNING:
        return None
    weights = np.ones((frames.rows, frames.cols), np.float32) if here.mask is None else here.mask
    coarse = means_of_blocks(weights[None], binning)[0]
    norm = np.maximum(_filtered(coarse, sigmas), 1e-6)
    cone, packed, packed_small = frames.beam == "cone", frames.packed(), small.packed()
    fine = _native.Renderer32(small.rows, small.cols, threads)
    residual, drawn = np.empty(weights.shape, np.float32), np.empty(coarse.shape, np.float32)
    images = np.empty((len(frames), *coarse.shape), np.float32)
    rough = smooth = 0.0
    for k, target in enumerate(here.images):
        renderer.render(packed[k], cone, *splats.arrays(), residual)
        fine.render(packed_small[k], cone, *splats.arrays(), drawn)
        expected = residual if excess is None else residual + excess(k, residual)
        np.subtract(expected, target, out=residual)
        if here.mask is not None:
            residual *= weights
        binned = _filtered(means_of_blocks(residual[None], binning)[0], sigmas)
        filtered = _without_blur((binned / norm).astype(np.float32, copy=False), drawn, coarse)
        images[k] = drawn - filtered
        rough += float(np.abs(residual).sum())
        smooth += float((np.abs(filtered) * coarse).sum())
    level = replace(
        here, binning=(here.binning[0] * binning[0], here.binning[1] * binning[1]), images=images,
        nominal=here.nominal.binned(*binning), mask=None if here.mask is None else coarse,
    )  # fmt: skip
    # A Gaussian of standard deviation s leaves 1 / (2 s sqrt(pi)) of the variance of white noise along an axis.
    shared = float(np.prod([max(1.0, 2 * s * np.sqrt(np.pi)) for s in sigmas]))
    views = len(frames)
    return LowPassed(
        level, fine, shared, rough / max(views * float(weights.sum()), 1), smooth / max(views * float(coarse.sum()), 1)
    )


def _width(splats: Splats, views: int) -> float:
    """Standard deviation of the filter at the isocentre, mm. Views share what is coarser than Crowther's frequency,
    views / (pi diameter)."""
    median = float(np.median(np.exp(np.log(splats.scales).mean(axis=1))))
    diameter = 4 * float(np.sqrt(np.linalg.eigvalsh(extent(splats))[-1]))
    return min(_SPLATS * median, _SHARED * np.pi * diameter / views)


def _without_blur(residual: Floats, drawn: Floats, weights: Floats) -> Floats:
    """The residual less what it would be to blur or to sharpen `drawn` along rows and along columns, by an amount of
    its own in every tile: the least squares of both, outliers hardly counted. All [rows, cols]."""
    deviation = NORMAL * float((np.abs(residual) * weights).mean()) / max(float(weights.mean()), 1e-6)
    weights = weights * np.minimum(1, HUBER * deviation / np.maximum(np.abs(residual), 1e-20))
    curved = [_curvature(drawn, axis) for axis in (0, 1)]
    starts = [np.arange(0, n, _TILE) for n in residual.shape]

    def sums(image: Floats) -> Array:
        return np.add.reduceat(np.add.reduceat(image, starts[0], axis=0), starts[1], axis=1).astype(np.float64)

    weighted = [weights * each for each in curved]
    normal = np.array([[sums(a * b) for b in curved] for a in weighted]).transpose(2, 3, 0, 1)  # [., ., 2, 2]
    right = np.array([sums(a * residual) for a in weighted]).transpose(1, 2, 0)
    ridge = (deviation / _BLUR) ** 2 + 1e-30
    amounts = np.linalg.solve(normal + ridge * np.eye(2), right[..., None])[..., 0].astype(np.float32)
    sizes = [np.diff(np.append(start, n)) for start, n in zip(starts, residual.shape, strict=True)]
    rows, cols = (np.repeat(np.repeat(amounts[..., k], sizes[0], axis=0), sizes[1], axis=1) for k in (0, 1))
    out: Floats = residual - rows * curved[0] - cols * curved[1]
    return out


def _curvature(image: Floats, axis: int) -> Floats:
    """Second differences along an axis, zero at its ends."""
    out = np.zeros_like(image)
    inner, along = np.moveaxis(out, axis, 0), np.moveaxis(image, axis, 0)
    inner[1:-1] = along[2:] - 2 * along[1:-1] + along[:-2]
    return out


def _filtered(image: Floats, sigmas: list[float]) -> Floats:
    out: Floats = ndimage.gaussian_filter(image, sigmas, mode="constant", truncate=_TAILS)
    return out
