"""Pixels that stand out alone are mended, and what belongs to the object is left as it is, to the bit."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from splatcore.scan import check_scan, read_scan
from splatcore.stray import mend_strays
from tests.core.scanfolder import COLS, ROWS, VIEWS, plain_images, write_scan

HEAD = Path(__file__).parents[2] / "examples" / "head"


def ball(rows: int = 64, cols: int = 96) -> np.ndarray:
    """A ball's line integrals, at most one, with noise of a hundredth."""
    r, c = np.mgrid[:rows, :cols]
    depth = np.sqrt(np.maximum(1 - ((r - rows / 2) / (rows / 3)) ** 2 - ((c - cols / 2) / (rows / 3)) ** 2, 0))
    return (depth + 0.01 * np.random.default_rng(0).normal(size=depth.shape)).astype(np.float32)


@pytest.mark.parametrize("value", [13.8, -7.0])
@pytest.mark.parametrize(
    "where", [[(32, 48)], [(0, 0)], [(63, 40)], [(20, 95)], [(30, 40), (31, 41)], [(9, 9), (50, 60)]]
)
def test_a_pixel_alone_or_two_become_their_neighbours_median(where: list[tuple[int, int]], value: float) -> None:
    clean = ball()
    image = clean.copy()
    for place in where:
        image[place] = value
    assert mend_strays(image) == len(where)
    rest = np.ones(image.shape, bool)
    for place in where:
        assert image[place] == pytest.approx(clean[place], abs=0.1)  # the ball's edge and the noise
        rest[place] = False
    np.testing.assert_array_equal(image[rest], clean[rest])


@pytest.mark.parametrize("shape", [(1, 96), (96, 1)])
def test_on_a_line_of_pixels_too(shape: tuple[int, int]) -> None:
    image = ball(96, 96)[48].reshape(shape)
    image.flat[50] = 14
    assert mend_strays(image) == 1
    assert image.flat[50] == pytest.approx(1, abs=0.1)


@pytest.mark.parametrize("dense", ["wire", "upright wire", "slanting wire", "bead", "step", "nothing but noise"])
def test_what_belongs_to_the_object_keeps_its_bits(dense: str) -> None:
    image = ball(160, 160)
    if dense == "wire":
        image[20, :] += 12
    elif dense == "upright wire":
        image[:, 17] += 12
    elif dense == "slanting wire":
        np.fill_diagonal(image, image.diagonal() + 12)
    elif dense == "bead":
        image[30:32, 70:72] += 12
    elif dense == "step":
        image[:, 159:] += 12
    else:
        image = np.random.default_rng(1).normal(size=image.shape).astype(np.float32)
    before = image.copy()
    assert mend_strays(image) == 0
    np.testing.assert_array_equal(image, before)


def test_a_large_view_is_judged_by_a_sample() -> None:
    image = ball(512, 1024)
    image[7, 7] = 14
    assert mend_strays(image) == 1


def test_an_empty_view_stays_empty() -> None:
    image = np.zeros((20, 20), np.float32)
    assert mend_strays(image) == 0
    assert not image.any()


def test_a_scan_is_read_without_them_and_says_so(tmp_path: Path) -> None:
    images = plain_images()
    images[2, 3, 4] = 1e3
    images[1, ROWS // 2, COLS // 2] = -1e3
    scan = read_scan(write_scan(tmp_path, images))
    assert scan.strays == 2
    assert np.abs(scan.projections).max() <= np.abs(plain_images()).max()
    assert len(scan.frames) == VIEWS
    assert any(text.startswith("2 pixels of views stand out alone") for text in check_scan(tmp_path).warnings)


def test_a_real_object_in_noise_has_none() -> None:
    assert read_scan(HEAD).strays == 0


def test_a_bead_alone_in_the_view_is_the_object() -> None:
    image = np.zeros((40, 40), np.float32)
    image[20, 20:22] = 0.9, 0.1
    assert mend_strays(image) == 0
