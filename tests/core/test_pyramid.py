"""Blocks of pixels: their means, and what a block with a bad pixel counts."""

from __future__ import annotations

import numpy as np
import pytest

from splatcore.pyramid import means_of_blocks


def images(rows: int = 50, cols: int = 67) -> np.ndarray:
    return np.random.default_rng(1).standard_normal((3, rows, cols)).astype(np.float32)


@pytest.mark.parametrize("binning", [(1, 2), (2, 1), (2, 2), (3, 2), (4, 4), (1, 8), (8, 8)])
def test_means_are_those_of_the_blocks_to_the_bit(binning):
    down, across = binning
    blocks = images()[:, : 50 // down * down, : 67 // across * across]
    blocks = blocks.reshape(3, 50 // down, down, 67 // across, across)
    means = means_of_blocks(images(), binning)
    assert means.dtype == np.float32 and means.flags.c_contiguous
    assert np.array_equal(means, blocks.mean(axis=(2, 4)))
    other = means_of_blocks(np.asfortranarray(images()), binning)
    assert np.allclose(other, means, atol=1e-6) and other.flags.c_contiguous


@pytest.mark.parametrize("binning", [(2, 2), (8, 8)])
def test_a_bad_pixel_counts_nothing_and_leaves_the_other_blocks_as_they_are(binning):
    good = np.ones((50, 67), np.float32)
    good[9, 12] = 0
    spoilt = images()
    spoilt[:, 9, 12] = 1e6
    means, clean = means_of_blocks(spoilt, binning, good), means_of_blocks(images(), binning)
    row, col = 9 // binning[0], 12 // binning[1]
    block = np.s_[:, row * binning[0] : (row + 1) * binning[0], col * binning[1] : (col + 1) * binning[1]]
    rest = good[block[1:]] > 0
    assert np.allclose(means[:, row, col], images()[block][:, rest].mean(axis=1), atol=1e-5)
    means[:, row, col] = clean[:, row, col]
    assert np.array_equal(means, clean)
