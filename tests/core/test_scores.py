"""PSNR and SSIM against their definitions, written out slowly."""

from __future__ import annotations

import math
import time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from splatcore import scores
from splatcore.scores import psnr, ssim


def slow_ssim_2d(x: np.ndarray, y: np.ndarray) -> float:
    """Wang's SSIM pixel by pixel: an 11 x 11 window laid over an image with zeros around it."""
    offset = np.arange(-5, 6)
    line = np.exp(-(offset**2) / (2 * 1.5**2))
    window = np.outer(line, line) / np.outer(line, line).sum()
    x, y = np.pad(x, 5), np.pad(y, 5)
    total = 0.0
    for r in range(x.shape[0] - 10):
        for c in range(x.shape[1] - 10):
            a, b = x[r : r + 11, c : c + 11], y[r : r + 11, c : c + 11]
            ma, mb = (window * a).sum(), (window * b).sum()
            va, vb = (window * a * a).sum() - ma**2, (window * b * b).sum() - mb**2
            cov = (window * a * b).sum() - ma * mb
            total += (2 * ma * mb + 1e-4) * (2 * cov + 9e-4) / ((ma**2 + mb**2 + 1e-4) * (va + vb + 9e-4))
    return total / ((x.shape[0] - 10) * (x.shape[1] - 10))


def slow_ssim(volume: np.ndarray, truth: np.ndarray) -> float:
    axes = []
    for axis in range(3):
        pairs = zip(np.moveaxis(volume, axis, 0), np.moveaxis(truth, axis, 0), strict=True)
        axes.append(np.mean([slow_ssim_2d(a, b) for a, b in pairs if b.any()]))
    return float(np.mean(axes))


def pair(seed: int = 0, shape: tuple[int, int, int] = (7, 12, 9)) -> tuple[np.ndarray, np.ndarray]:
    """A truth with zero slices on every axis, unlike in number, and a noisy copy."""
    rng = np.random.default_rng(seed)
    truth = rng.random(shape)
    truth[:1], truth[:, -2:], truth[:, :, :3] = 0, 0, 0
    return truth + rng.normal(0, 0.1, shape), truth


def test_ssim_is_its_definition() -> None:
    volume, truth = pair()
    assert ssim(volume, truth) == pytest.approx(slow_ssim(volume, truth), rel=1e-12)


def test_ssim_in_chunks_is_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    volume, truth = pair()
    whole = ssim(volume, truth)
    monkeypatch.setattr(scores, "_CHUNK", 150)
    assert ssim(volume, truth) == pytest.approx(whole, rel=1e-12)


def test_slices_of_zero_truth_do_not_count() -> None:
    """They would otherwise score 1 where the volume is zero too, or nearly 0 where it is not."""
    volume, truth = pair()
    changed = volume.copy()
    padded = np.pad(truth, ((0, 4), (0, 0), (0, 0)))
    for value in (0.0, 5.0):
        across_z = np.stack([*volume, *np.full((4, *volume.shape[1:]), value)])
        assert scores._ssim_across(across_z, padded, 1.0) == scores._ssim_across(volume, truth, 1.0)
    changed[0] += 1  # slice 0 of z is all zero in the truth
    assert scores._ssim_across(changed, truth, 1.0) == scores._ssim_across(volume, truth, 1.0)


def test_psnr_is_its_definition() -> None:
    volume, truth = pair()
    assert psnr(volume, truth) == pytest.approx(10 * math.log10(1 / ((volume - truth) ** 2).mean()), rel=1e-12)
    assert psnr(truth + 0.1, truth) == pytest.approx(20)
    assert psnr(truth, truth) == math.inf


@given(st.floats(1e-3, 1e3), st.integers(0, 99))
@settings(max_examples=10, deadline=None)
def test_only_the_unit_sets_the_scale(unit: float, seed: int) -> None:
    volume, truth = pair(seed)
    assert psnr(volume * unit, truth * unit, unit) == pytest.approx(psnr(volume, truth), rel=1e-9)
    assert ssim(volume * unit, truth * unit, unit) == pytest.approx(ssim(volume, truth), rel=1e-9)


def test_nothing_is_clipped_or_masked() -> None:
    truth = np.zeros((4, 4, 4))
    truth[0] = 1
    volume = truth.copy()
    volume[3] = -2.0
    assert psnr(volume, truth) == pytest.approx(0.0)  # MSE = 4 / 4


def test_a_perfect_volume_and_an_empty_truth() -> None:
    volume, truth = pair()
    assert ssim(truth, truth) == pytest.approx(1.0)
    assert math.isnan(ssim(volume, 0 * truth))


def test_shapes_must_agree() -> None:
    with pytest.raises(ValueError, match="expected two alike"):
        ssim(np.zeros((3, 3, 3)), np.zeros((3, 3, 4)))
    with pytest.raises(ValueError, match="expected two alike"):
        psnr(np.zeros((3, 3)), np.zeros((3, 3)))


def test_a_full_size_volume_is_scored_in_seconds() -> None:
    rng = np.random.default_rng(0)
    truth = rng.random((96, 96, 96), np.float32)
    began = time.process_time()
    value = ssim(truth + np.float32(0.05), truth)
    assert 0.9 < value < 1
    assert time.process_time() - began < 10  # about half a second; the slow definition takes minutes
