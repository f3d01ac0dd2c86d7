"""Exposure that drifts from view to view: found, taken out, told; and not found where there is none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from splatcore import _native
from splatcore.clipping import Clipping
from splatcore.errors import OptionsError
from splatcore.exposure import Exposure, finding, offsets
from splatcore.geometry import Frames, circular
from splatcore.options import Options
from splatcore.reconstruct import drain, reconstruct
from splatcore.reconstruction import Reconstruction
from splatcore.scan import Scan
from splatcore.simulate import project
from splatcore.splats import Floats, Splats

from .phantom import phantom
from .test_geometries import CUBE, EDGE, UNIT, errors, even, jitter, orbit, psnr, scan_of

OPTIONS = Options(quality="preview", threads=1)
VIEWS, SIDE = 12, 48


def scene(half_width: float = 60.0) -> tuple[Splats, Frames, _native.Renderer32, Floats]:
    """Splats within +-half_width mm, views 240 mm wide at the axis, and the images."""
    rng = np.random.default_rng(0)
    splats = Splats(
        rng.uniform(-half_width, half_width, (60, 3)).astype(np.float32),
        rng.uniform(8, 14, (60, 3)).astype(np.float32),
        rng.normal(size=(60, 4)).astype(np.float32),
        rng.uniform(0.002, 0.01, 60).astype(np.float32),
    )
    frames = circular("cone", even(VIEWS), 500, 700, SIDE, SIDE, (7.0, 7.0))
    renderer = _native.Renderer32(SIDE, SIDE, 1)
    images = np.empty((VIEWS, SIDE, SIDE), np.float32)
    for image, frame in zip(images, frames.packed(), strict=True):
        renderer.render(frame, True, *splats.arrays(), image)
    return splats, frames, renderer, images


def test_offsets_of_a_known_object_are_found_to_within_the_noise() -> None:
    splats, frames, renderer, images = scene()
    rng = np.random.default_rng(1)
    true = rng.normal(0.01, 0.03, VIEWS)
    noisy = images + true[:, None, None].astype(np.float32) + rng.normal(0, 0.01, images.shape).astype(np.float32)
    noisy[:, 20:24, 20:24] += 3  # what the model does not know: a median does not mind
    found = offsets(renderer, splats, frames, noisy, None, float(images.max()))
    assert np.abs(found - true).max() < 4 * 1.25 * 0.01 / np.sqrt(0.3 * SIDE**2)


def test_masked_pixels_have_no_say() -> None:
    splats, frames, renderer, images = scene()
    mask = np.ones((SIDE, SIDE), np.float32)
    mask[:, : SIDE * 2 // 3] = 0
    spoiled = images + 0.5 * (1 - mask)
    found = offsets(renderer, splats, frames, spoiled, mask, float(images.max()))
    assert np.abs(found).max() < 1e-3
    assert np.abs(offsets(renderer, splats, frames, spoiled, None, float(images.max()))).min() > 0.1


def test_what_all_views_share_is_told_by_air_alone() -> None:
    drift = np.linspace(0.0, 0.06, VIEWS)  # mean 0.03
    for width, air in ((60.0, True), (170.0, False)):
        splats, frames, renderer, images = scene(width)
        dense = replace(splats, scales=splats.scales * (1 if air else 4))
        for image, frame in zip(images, frames.packed(), strict=True):
            renderer.render(frame, True, *dense.arrays(), image)
        moved = images + drift[:, None, None].astype(np.float32)
        found = offsets(renderer, dense, frames, moved, None, float(images.max()))
        assert found.mean() == pytest.approx(0.03 if air else 0.0, abs=1e-3)
        assert found - found.mean() == pytest.approx(drift - 0.03, abs=1e-3)


def test_nothing_is_copied_where_there_is_nothing_to_correct() -> None:
    images = np.zeros((3, 4, 5), np.float32)
    exposure = Exposure(3)
    assert exposure.corrected(images) is images
    exposure.offset = np.array([0.0, 0.1, -0.1])
    assert exposure.corrected(images)[:, 0, 0] == pytest.approx([0, -0.1, 0.1])


def drifting(drift: np.ndarray) -> tuple[Scan, Frames]:
    nominal = orbit(even(24))
    true = jitter(nominal, 0.03, 4.0)
    scan = scan_of(nominal, true)
    return replace(scan, projections=scan.projections + drift[:, None, None].astype(np.float32)), true


def said(result: Reconstruction) -> dict:
    return next(f for f in result.report["findings"] if f["name"] == "exposure")


@pytest.mark.slow
def test_a_drifting_tube_is_found_and_does_no_harm() -> None:
    drift = np.linspace(-0.05, 0.05, 24) + np.random.default_rng(4).normal(0, 0.02, 24)
    scan, true = drifting(drift)
    result, without = (drain(reconstruct(scan, replace(OPTIONS, exposure=on))) for on in (True, False))
    assert np.std(np.array(said(result)["evidence"]["offset"]) - drift) < 0.002  # of 0.036; noise of a pixel: 0.008
    assert said(result)["severity"] == "warning"
    # Without a correction views go astray: 15 degrees and more.
    assert errors(true, result.corrected)[0] < 0.8 < 3 < errors(true, without.corrected)[0]
    assert psnr(result, true) > psnr(without, true) + 6


@pytest.mark.slow
def test_a_steady_tube_is_left_alone() -> None:
    scan, true = drifting(np.zeros(24))
    result, without = (drain(reconstruct(scan, replace(OPTIONS, exposure=on))) for on in (True, False))
    assert psnr(result, true) > psnr(without, true) - 0.15
    assert said(result)["evidence"]["rms"] < 0.002
    assert not [f for f in without.report["findings"] if f["name"] == "exposure"]


def test_the_finding_speaks_of_gain() -> None:
    assert finding(np.zeros(4))["severity"] == "ok"
    text = finding(np.log([1.0, 1.02, 0.98, 1.0]))["text"]
    assert "0.9804" in text and "1.0204" in text


def test_the_option_is_a_switch() -> None:
    assert Options.from_dict({"exposure": False}).exposure is False
    with pytest.raises(OptionsError, match="exposure: got 1"):
        Options.from_dict({"exposure": 1})


@pytest.mark.parametrize("drift", [0.0, 0.01])
def test_noise_clipped_at_zero_feigns_no_exposure(drift: float) -> None:
    """In blocks of pixels it lifts the median of air by 0.4 standard deviations."""
    splats, frames, renderer, images = scene()
    rng, deviation = np.random.default_rng(2), 0.02
    true = drift * rng.normal(size=VIEWS)
    fine = np.repeat(np.repeat(images + true[:, None, None].astype(np.float32), 4, axis=1), 4, axis=2)
    clipped = np.maximum(fine + rng.normal(0, deviation, fine.shape).astype(np.float32), 0)
    blocks = clipped.reshape(VIEWS, SIDE, 4, SIDE, 4).mean(axis=(2, 4))
    noise, exposure, top = Clipping(deviation), Exposure(VIEWS), float(images.max())
    assert abs(offsets(renderer, splats, frames, blocks, None, top).mean() - true.mean()) > 0.2 * deviation
    for _ in range(30):  # a view whose air is below zero shows little of it
        exposure.offset = offsets(
            renderer, splats, frames, blocks, None, top,
            lambda k, drawn: noise.excess(drawn, float(exposure.offset[k])),
        )  # fmt: skip
    assert np.abs(exposure.offset - true).max() < 0.1 * deviation


@pytest.mark.parametrize("drift", [0.0, 0.03])
def test_the_exposure_that_is_found_is_not_that_of_clipped_noise(drift: float) -> None:
    """Otherwise 0.02 is found where nothing drifts, and single views are 0.06 to 0.08 off."""
    nominal, deviation, rng = orbit(even(24)), 0.05, np.random.default_rng(6)
    true = drift * rng.normal(size=24)
    whole = project(phantom(EDGE) * np.float32(UNIT), CUBE, nominal, 1) + true[:, None, None]
    clipped = np.maximum(whole + rng.normal(0, deviation, whole.shape), 0).astype(np.float32)
    scan = Scan("phantom", clipped, nominal, CUBE)
    result = drain(reconstruct(scan, replace(OPTIONS, calibrate="none")))
    found = np.array(said(result)["evidence"]["offset"])
    assert np.abs(found - true).max() < (0.04 if drift else 1e-9)
