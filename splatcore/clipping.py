"""Noise that was clipped at zero, so that what was measured is in the mean more than what was there.

Line integrals below zero do not exist, and many a scanner's software (and the noise of R2-Gaussian's protocol) sets
them to zero. In air half the noise is gone then, and its mean is 0.4 standard deviations. Poses found by least squares
follow that mean: air seems to absorb, a larger shadow takes up more of that, so views of thin objects turn away from
their edge. The median, which is what splats are fitted to, is not moved by clipping. (docs/method.md, section 4)
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from splatcore.projections import Mask
from splatcore.splats import Floats

_VIEWS, _PIXELS = 16, 2**22  # that the noise is taken from, at most: of large views every so many rows
_APART = 3  # pixels from a zero to the next one looked at: noise of neighbours may go together
_LEAST = 0.01  # share of pixels that are exactly zero: fewer are no air
_NEGATIVE = 0.001  # share of them that may be below zero where noise is clipped
_MIXED = (0.2, 0.7)  # share of positive pixels between zeros: half in air, hardly any where there is no noise at all
_ENOUGH = 50  # such pixels
_QUARTILES = (0.15, 0.6)  # first over third: 0.277 of clipped normal noise, 1 of thin wires all alike
_STANDS_OUT = (1e-6, 0.2)  # deviation over the largest value: smaller is rounding, larger no image of an object
_MEDIAN = 0.6745  # of the absolute value of a standard normal deviate
# -log of the mean of max(0, n + z) - z for z >= 0, n standard normal: right to 0.00013 of a standard deviation.
_LOG = (0.918939, 1.253314, 0.285398, 0.0265)


@dataclass(frozen=True)
class Clipping:
    """How far clipping at zero moves the mean of a pixel."""

    deviation: float  # of the noise in air, line integral; zero where nothing is clipped

    def excess(self, drawn: Floats, offset: float = 0.0) -> Floats:
        """What it adds to the mean of pixels whose line integrals are `drawn`, measured with an offset more.

        With z the true value in standard deviations: phi(z) - z Phi(-z), of them; by z more at -z."""
        z = (drawn + np.float32(offset)) * np.float32(1 / self.deviation)
        size = np.minimum(np.abs(z), 10)
        a, b, c, d = (np.float32(each) for each in _LOG)
        out: Floats = np.exp(-(a + size * (b + size * (c + size * d)))) - np.minimum(z, 0)
        return np.float32(self.deviation) * out


def clipping(projections: Floats, bad_pixels: Mask | None) -> Clipping:
    """Whether line integrals [views, rows, cols] are clipped at zero, and the noise that they had. bad_pixels [rows,
    cols] or None.

    Told by the pixels between two exact zeros: in air half of them are positive, and as far from zero as noise is."""
    picked = np.unique(np.linspace(0, len(projections) - 1, min(len(projections), _VIEWS)).astype(int))
    rows = slice(None, None, max(1, len(picked) * projections[0].size // _PIXELS))
    images = np.stack([projections[view][rows] for view in picked])
    good = np.ones(images.shape[1:], bool) if bad_pixels is None else ~bad_pixels[rows]
    if images.shape[2] == 1:  # a detector of one column: its rows are beside each other
        images, good = images.swapaxes(1, 2), good.T
    zero = (images == 0) & good
    many = np.count_nonzero(zero)
    if many < _LEAST * np.count_nonzero(good) * len(images) or np.count_nonzero((images < 0) & good) > _NEGATIVE * many:
        return Clipping(0.0)
    inside = slice(_APART, -_APART)
    amid = zero[:, :, : -2 * _APART] & zero[:, :, 2 * _APART :] & good[:, inside]
    between = images[:, :, inside][amid]
    positive = between[between > 0]
    if positive.size < _ENOUGH or not _MIXED[0] * between.size < positive.size < _MIXED[1] * between.size:
        return Clipping(0.0)
    first, middle, third = np.quantile(positive, (0.25, 0.5, 0.75))
    deviation, top = float(middle) / _MEDIAN, float(images.max(where=good, initial=0))
    like_noise = _QUARTILES[0] * third < first < _QUARTILES[1] * third
    if not like_noise or not _STANDS_OUT[0] * top < deviation < _STANDS_OUT[1] * top:
        return Clipping(0.0)
    return Clipping(deviation)
