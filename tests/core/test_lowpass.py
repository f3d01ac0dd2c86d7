"""Residuals at the resolution of the splats, as the poses of the finest level see them."""

from __future__ import annotations

import numpy as np
import pytest

from splatcore import _native, lowpass
from splatcore.geometry import circular
from splatcore.grid import VolumeGrid
from splatcore.lowpass import _without_blur, low_passed
from splatcore.pyramid import Level
from splatcore.splats import Splats

VIEWS, EDGE, PITCH = 4, 64, 4.0


def scene(scale: float = 6.0):
    """Forty round splats seen by four views, and the level that holds their images."""
    rng = np.random.default_rng(0)
    splats = Splats(
        rng.uniform(-45, 45, (40, 3)).astype(np.float32),
        np.full((40, 3), scale, np.float32),
        np.tile(np.float32([1, 0, 0, 0]), (40, 1)),
        rng.uniform(0.002, 0.01, 40).astype(np.float32),
    )
    frames = circular("cone", np.arange(VIEWS) * 90.0, 500, 700, EDGE, EDGE, (PITCH, PITCH))
    renderer = _native.Renderer32(EDGE, EDGE, 1)
    grid = VolumeGrid((32, 32, 32), (5.0, 5.0, 5.0), (0.0, 0.0, 0.0))
    return splats, renderer, Level(1, (1, 1), frames, draw(renderer, splats, frames), None, grid)


def draw(renderer, splats, frames) -> np.ndarray:
    images = np.empty((len(frames), frames.rows, frames.cols), np.float32)
    for image, frame in zip(images, frames.packed(), strict=True):
        renderer.render(frame, True, *splats.arrays(), image)
    return images


def residual(soft, splats) -> np.ndarray:
    """What the splats' images of the low-passed level leave."""
    return draw(soft.renderer, splats, soft.here.nominal) - soft.here.images


def gaussian(size: int, sigma: float) -> np.ndarray:
    """The kernel cut at three standard deviations as a matrix, every row of which sums to one."""
    away = np.abs(np.arange(size)[:, None] - np.arange(size))
    kernel = np.where(away <= int(3 * sigma + 0.5), np.exp(-0.5 * (away / sigma) ** 2), 0)
    return kernel / kernel.sum(axis=1, keepdims=True)


def test_an_object_that_fits_leaves_nothing():
    splats, renderer, here = scene()
    soft = low_passed(here, here.nominal, renderer, splats, 1)
    assert soft is not None and soft.rough < 1e-9 and soft.smooth < 1e-9
    np.testing.assert_allclose(residual(soft, splats), 0, atol=1e-6 * here.images.max())


def test_residuals_are_binned_and_filtered_as_wide_as_the_splats(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(lowpass, "_without_blur", lambda residual, *_: residual)  # which has a test of its own
    splats, renderer, here = scene()
    noise = np.random.default_rng(1).normal(0, 0.1, here.images.shape).astype(np.float32)
    noisy = Level(1, (1, 1), here.nominal, here.images + noise, None, here.grid)
    soft = low_passed(noisy, here.nominal, renderer, splats, 1)
    assert soft is not None
    # Half as wide again as a splat; a binned pixel is 8 mm on the detector, which shows everything 1.4 times larger.
    kernel = gaussian(EDGE // 2, 1.5 * 6.0 * 1.4 / (2 * PITCH))
    binned = -noise.astype(np.float64).reshape(VIEWS, EDGE // 2, 2, EDGE // 2, 2).mean(axis=(2, 4))
    np.testing.assert_allclose(residual(soft, splats), kernel @ binned @ kernel.T, atol=1e-5)
    assert soft.rough == pytest.approx(np.abs(noise).mean(), rel=1e-4)
    inside = residual(soft, splats)[:, 8:-8, 8:-8]
    assert soft.shared * inside.var() == pytest.approx(binned.var(), rel=0.25)  # of which few are independent


def test_what_blur_explains_is_taken_out_and_what_motion_explains_is_not():
    here = scene()[2]
    image, good = here.images[0], np.ones((EDGE, EDGE), np.float32)
    left, right, up, down = (np.roll(image, *way) for way in ((-1, 1), (1, 1), (-1, 0), (1, 0)))
    amounts = np.repeat(np.repeat(np.random.default_rng(3).uniform(-0.1, 0.1, (4, 4)), 16, axis=0), 16, axis=1)
    blurred = (amounts * (left - 2 * image + right) + 0.05 * (up - 2 * image + down)).astype(np.float32)
    shifted = 0.05 * (left - right)
    assert np.linalg.norm(_without_blur(blurred, image, good)) < 0.1 * np.linalg.norm(blurred)
    kept = _without_blur(shifted, image, good)  # tiles cut through blobs, so that a little is lost
    assert float((kept * shifted).sum()) > 0.95 * float((shifted * shifted).sum())
    np.testing.assert_array_equal(_without_blur(np.zeros_like(image), image, good), 0)


def test_bad_pixels_have_no_say():
    splats, renderer, here = scene()
    mask = np.ones((EDGE, EDGE), np.float32)
    mask[10:14, 20:27] = 0
    images = here.images + np.random.default_rng(2).normal(0, 0.1, here.images.shape).astype(np.float32)
    broken = np.where(mask > 0, images, np.float32(1e6))
    one, other = (
        low_passed(Level(1, (1, 1), here.nominal, which, mask, here.grid), here.nominal, renderer, splats, 1)
        for which in (images, broken)
    )
    assert one is not None and other is not None and one.here.mask is not None
    np.testing.assert_array_equal(one.here.images, other.here.images)
    assert one.here.mask[5, 10] == 0 and one.here.mask[0, 0] == 1


def test_a_line_detector_is_binned_along_its_line():
    splats, _, here = scene()
    frames = circular("cone", np.arange(VIEWS) * 90.0, 500, 700, 1, EDGE, (PITCH, PITCH))
    renderer = _native.Renderer32(1, EDGE, 1)
    line = Level(1, (1, 1), frames, draw(renderer, splats, frames), None, here.grid)
    soft = low_passed(line, frames, renderer, splats, 1)
    assert soft is not None and soft.here.images.shape == (VIEWS, 1, EDGE // 2)
    np.testing.assert_allclose(residual(soft, splats), 0, atol=1e-6 * line.images.max())


def test_splats_finer_than_pixels_are_left_alone():
    splats, renderer, here = scene(scale=0.5)
    assert low_passed(here, here.nominal, renderer, splats, 1) is None
