"""The exposure of single views: a tube or a shutter that drifts adds a constant to every line integral of a view.

With gain g_k the view's image is p - ln g_k = p + b_k. Given the splats' image I, b_k minimises the weighted sum of
|m - I - b_k| over pixels and b_k^2 / (2 sigma_b^2) beside it: a weighted median, shrunk by the prior. The weight is
1 / (1 + (I / I_0)^2), for errors of the model and the noise grow with what is absorbed; so air decides where there is
air, and all pixels do where there is none.

What all views share is another matter. Splats can imitate a constant (a faint fog round the object), and a truncated
object can take it up entirely. Only air tells, so where there is too little of it the mean of all b_k is left at 0.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from splatcore import _native
from splatcore.geometry import Array, Frames
from splatcore.splats import Floats, Splats

_TOLERANCE = 0.05  # one standard deviation of b: a tube that differs by more from view to view is broken
_AIR = 0.02  # of the largest line integral: I_0
_LEAST_AIR = 0.01  # share of pixels below I_0 from which what all views share may be told
# Shares of the largest line integral, below which nothing is corrected.
_LEAST_SPREAD, _LEAST_MEAN = 0.001, 0.01
_WORTH_TELLING = 0.002  # RMS of b over views, below which nothing is said


class Exposure:
    """What single views were over- or underexposed by, as far as it is known by now."""

    def __init__(self, views: int) -> None:
        self.offset: Array = np.zeros(views)  # b_k

    def corrected(self, images: Floats) -> Floats:
        """The line integrals [views, rows, cols] without the offsets: a copy, unless there are none."""
        if not self.offset.any():
            return images
        return images - self.offset.astype(np.float32)[:, None, None]

    def update(
        self,
        renderer: _native.Renderer32,
        splats: Splats,
        frames: Frames,
        images: Floats,
        mask: Floats | None,
        excess: Callable[[int, Floats], Floats] | None = None,
    ) -> None:
        """Find the offsets anew from the images as measured; zero where they are too small to be worth a correction.

        excess: what the images of a view, drawn as given, hold beyond it but for its offset (splatcore.clipping)."""
        top = float(images.max())
        found = offsets(renderer, splats, frames, images, mask, top, excess)
        worth = found.std() > _LEAST_SPREAD * top or abs(found.mean()) > _LEAST_MEAN * top
        self.offset = found if worth else np.zeros_like(found)


def offsets(
    renderer: _native.Renderer32,
    splats: Splats,
    frames: Frames,
    images: Floats,
    mask: Floats | None,
    top: float,
    excess: Callable[[int, Floats], Floats] | None = None,
) -> Array:
    """b_k of every view, given the splats: unitless, to be taken from the view's line integrals. [views]

    images [views, rows, cols] as measured; mask [rows, cols] share of good pixels; top: largest line integral; excess
    as for `Exposure.update`."""
    found, air = np.zeros(len(frames)), 0.0
    drawn, level = np.empty(images.shape[1:], np.float32), _AIR * top
    for k, frame in enumerate(frames.packed()):
        renderer.render(frame, frames.beam == "cone", *splats.arrays(), drawn)
        weight = 1 / (1 + (drawn.astype(np.float64) / level) ** 2)
        if mask is not None:
            weight = weight * mask
        air += float((weight > 0.5).mean()) / len(frames)
        difference = images[k] - (drawn if excess is None else drawn + excess(k, drawn))
        middle, spread = _median(difference, weight)
        variance = spread**2 / max(float(weight.sum()), 1e-9)
        found[k] = middle * _TOLERANCE**2 / (_TOLERANCE**2 + variance)
    return found if air > _LEAST_AIR else found - found.mean()


def _median(values: Floats, weights: Array) -> tuple[float, float]:
    """(weighted median, weighted mean distance from it)"""
    flat, weight = values.ravel(), weights.ravel()
    order = np.argsort(flat)
    sums = np.cumsum(weight[order])
    if not sums[-1] > 0:
        return 0.0, 0.0
    middle = float(flat[order[np.searchsorted(sums, sums[-1] / 2)]])
    return middle, float((weight * np.abs(flat - middle)).sum() / sums[-1])


def finding(found: Array) -> dict[str, Any]:
    """What the report says of it. found [views]: b_k."""
    gain = np.exp(-found)
    spread, mean = float(found.std()), float(found.mean())
    drifts = float(np.sqrt((found**2).mean())) > _WORTH_TELLING
    text = "All views are exposed alike, as far as the images tell."
    if drifts:
        text = (
            f"The exposure differs between views: {spread:.2%} RMS, from {gain.min():.4f} to {gain.max():.4f} of what "
            f"the flat image says ({np.exp(-mean):.4f} in the mean). The images were corrected for it."
        )
    return {
        "name": "exposure",
        "severity": "warning" if drifts else "ok",
        "text": text,
        "evidence": {"rms": spread, "mean": mean, "offset": found.tolist()},
    }
