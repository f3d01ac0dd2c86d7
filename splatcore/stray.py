"""Pixels of a view that stand out alone: dead, hot, or hit by a stray ray, and in no list of bad pixels.

One of them in one view of fifty cost a decibel: the largest line integral sets the scale of the loss. Only what is
out of all proportion is touched, so that scans without such pixels keep their bits.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from splatcore.splats import Floats

_LEVEL, _BEYOND = 0.99, 2.0  # beyond so many times that quantile of a view's line integrals
_ALONE = 0.5  # the second largest neighbour is below this share of it: wires, and corners of beads, have two as large
_SAMPLE = 2**16  # pixels of a large view that the quantile is taken from
_AROUND = np.array([(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1) if i or j])
_ALONG = np.array([-2, -1, 1, 2])  # on a detector of a single row or column


def mend_strays(image: Floats) -> int:
    """Gives pixels that stand out alone the median of their neighbours, in place. Returns how many they were.

    image [rows, cols]: line integrals. Of pixels that touch, pairs are found; larger patches may be of the object. So
    may the end of a wire, which is lost where the wire is one sharp pixel wide.
    """
    size = np.abs(image)
    stride = max(1, size.size // _SAMPLE)
    stride += stride > 1 and image.shape[1] % stride == 0  # not the same columns in every row
    limit = _BEYOND * float(np.quantile(size.ravel()[::stride], _LEVEL))
    if not limit > 0:  # no more than a speck in all the view: it is the object
        return 0
    rows, cols = np.nonzero(size > limit)
    if not len(rows):
        return 0
    down, across = _steps(image.shape)
    r, c = rows[:, None] + down, cols[:, None] + across  # [pixels, neighbours]
    inside = (r >= 0) & (r < image.shape[0]) & (c >= 0) & (c < image.shape[1])
    near = np.where(inside, image[np.where(inside, r, 0), np.where(inside, c, 0)], np.nan)
    largest = np.sort(np.where(inside, np.abs(near), 0), axis=1)
    # At the rim a wire has one neighbour only, the next is beyond the detector.
    beside = np.where(inside.all(axis=1), largest[:, -2], largest[:, -1])
    alone = beside < _ALONE * size[rows, cols]
    image[rows[alone], cols[alone]] = np.nanmedian(near[alone], axis=1)
    return int(np.count_nonzero(alone))


def told(count: int) -> str:
    """What was done about so many, for people."""
    few = f"{count} pixel{'s of views stand' if count > 1 else ' of a view stands'} out alone"
    return f"{few} (dead, hot, or hit by a stray ray), taken from the neighbours; list what is dead in bad_pixels"


def _steps(shape: tuple[int, ...]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Rows and columns from a pixel to its neighbours."""
    if 1 not in shape:
        return _AROUND[:, 0], _AROUND[:, 1]
    still = np.zeros_like(_ALONG)
    return (still, _ALONG) if shape[0] == 1 else (_ALONG, still)
