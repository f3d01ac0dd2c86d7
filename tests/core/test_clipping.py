"""Noise clipped at zero: found where it is, and the poses are not moved by it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.ndimage import binary_erosion, gaussian_filter
from scipy.stats import norm

from splatcore import _native
from splatcore.calibration import Calibration
from splatcore.clipping import Clipping, clipping
from splatcore.geometry import circular
from splatcore.grid import VolumeGrid
from splatcore.options import Options
from splatcore.poses import Normals, step_full
from splatcore.pyramid import Level, level
from splatcore.reconstruct import drain, reconstruct, resolved
from splatcore.scan import Scan, read_scan
from splatcore.simulate import Simulation, simulate
from splatcore.splats import Splats

from .phantom import phantom


def air(deviation: float, shape: tuple[int, ...] = (20, 48, 48), seed: int = 0) -> np.ndarray:
    """A box that absorbs, in air, with noise. Float32, unclipped."""
    rng = np.random.default_rng(seed)
    images = np.zeros(shape)
    images[:, shape[1] // 4 : -shape[1] // 4, shape[2] // 3 : -shape[2] // 3] = 1.0
    return (images + rng.normal(0, deviation, shape)).astype(np.float32)


@pytest.mark.parametrize("offset", [0.0, -1.3, 0.5])
def test_the_excess_is_the_mean_of_clipped_noise(offset: float) -> None:
    z = np.linspace(0, 8, 400, dtype=np.float32)
    at = z + offset
    exact = 0.02 * (norm.pdf(at) - at * norm.cdf(-at))
    assert np.abs(Clipping(0.02).excess(0.02 * z, 0.02 * offset) - exact).max() < 0.02 * 1.5e-4


def test_the_excess_is_what_drawing_shows() -> None:
    rng = np.random.default_rng(1)
    noise = rng.normal(0, 0.1, 400_000)
    for true in (0.0, 0.05, 0.2):
        more = np.maximum(true + noise, 0).mean() - true
        assert Clipping(0.1).excess(np.float32([true]))[0] == pytest.approx(more, abs=5e-4)


# Of some 4,000 deviates a median is known to 2 %.
@pytest.mark.parametrize("deviation", [0.003, 0.05])
def test_clipped_noise_is_found_and_measured(deviation: float) -> None:
    assert clipping(np.maximum(air(deviation), 0), None).deviation == pytest.approx(deviation, rel=0.06)


def test_a_line_detector_whose_line_is_a_column() -> None:
    images = np.maximum(air(0.05, (20, 48, 192))[:, 24:25], 0).swapaxes(1, 2)
    assert clipping(images, None).deviation == pytest.approx(0.05, rel=0.3)
    assert clipping(np.ascontiguousarray(images.swapaxes(1, 2)), None) == clipping(images, None)


def test_nothing_is_clipped_where_noise_is_whole_or_absent() -> None:
    whole = air(0.05)
    assert clipping(whole, None) == Clipping(0.0)
    assert clipping(np.maximum(whole, 0) - np.float32(0.01), None) == Clipping(0.0)  # then moved
    assert clipping(np.rint(np.maximum(air(0.0), 0)), None) == Clipping(0.0)  # no noise
    assert clipping(air(0.05) + 1, None) == Clipping(0.0)  # no air


def test_air_that_lies_off_zero_is_left_alone() -> None:
    """What zeros are left there are too few to tell the noise by."""
    assert clipping(np.maximum(air(0.05) + np.float32(0.06), 0), None) == Clipping(0.0)


def test_noise_that_neighbours_share_is_measured_in_full() -> None:
    noise = gaussian_filter(np.random.default_rng(3).normal(0, 1, (20, 48, 48)), (0, 0.6, 0.6))
    shared = air(0.0) + np.float32(0.05 / noise.std()) * noise.astype(np.float32)
    assert clipping(np.maximum(shared, 0), None).deviation == pytest.approx(0.05, rel=0.1)


def test_zeros_that_are_no_noise_are_not_believed() -> None:
    dots = (np.random.default_rng(5).random((16, 48, 48)) < 0.3).astype(np.float32)
    assert clipping(dots, None) == Clipping(0.0)  # all alike
    assert clipping(np.maximum(air(0.4)[:, :8], 0), None) == Clipping(0.0)  # no object
    assert clipping(np.maximum(air(1e-8), 0), None) == Clipping(0.0)  # rounding
    assert clipping(np.float32([[[0, 0.5, 0, 0, 0, 0.2, 3, 3]]]), None) == Clipping(0.0)  # too few to tell
    some = np.maximum(air(0.05), 0)
    some[:, :, 0] -= np.float32(0.01)
    assert clipping(some, None) == Clipping(0.0)  # zeros beside values below zero


def test_bad_pixels_do_not_count() -> None:
    images = np.maximum(air(0.05), 0)
    bad = np.zeros(images.shape[1:], bool)
    bad[:, ::2] = True
    images[:, bad] = 0
    assert clipping(images, bad) == Clipping(0.0)  # no good one lies amid two others
    bad[:] = False
    bad[::3] = True
    images = np.maximum(air(0.05), 0)
    images[:, bad] = 7
    assert clipping(images, bad).deviation == pytest.approx(0.05, rel=0.06)


def plate_turned_by_noise(
    seen: Callable[[Calibration, Level, Any], Normals], clipped: bool = True
) -> tuple[float, float]:
    """By how much noise turns views of a known plate away from their edge, in the mean, and the standard error of that.
    Milliradians."""
    views, deviation, rng = 96, 0.05, np.random.default_rng(4)
    x, z = (each.ravel() for each in np.meshgrid(np.arange(-40, 41, 4), np.arange(-24, 25, 4)))
    plate = Splats(
        np.stack([x, 0 * x, z], axis=1).astype(np.float32),
        np.tile(np.float32([3, 1.5, 3]), (len(x), 1)),
        np.tile(np.float32([1, 0, 0, 0]), (len(x), 1)),
        np.full(len(x), 0.03, np.float32),
    )
    angles = np.linspace(0, 360, views, endpoint=False) + 0.25
    frames = circular("cone", angles, 500, 700, 320, 320, (0.6, 0.6))
    renderer, images = _native.Renderer32(320, 320, 1), np.empty((views, 320, 320), np.float32)
    for image, frame in zip(images, frames.packed(), strict=True):
        renderer.render(frame, True, *plate.arrays(), image)
    noisy = images + rng.normal(0, deviation, images.shape).astype(np.float32)
    noisy = np.maximum(noisy, 0) if clipped else noisy
    scan = Scan("plate", noisy, frames, VolumeGrid((24, 32, 32), (3.0, 3.0, 3.0)))
    calibration = Calibration(scan, resolved(scan, Options(threads=1)))
    normals = seen(calibration, level(scan, 1), SimpleNamespace(renderer=renderer, splats=plate))
    turn = -1e3 * normals.gradient[:, 2] / normals.hessian[:, 2, 2]
    # The source, on the x axis at first, goes round in the angle's sense; the object's own turn is the other way.
    larger = -turn * np.sign(np.sin(np.deg2rad(2 * angles)))
    away = np.abs(np.rad2deg(np.arctan(np.tan(np.deg2rad(angles)))))
    near_edge = larger[(away > 3) & (away < 60)]
    return float(near_edge.mean()), float(near_edge.std() / np.sqrt(len(near_edge)))


SEEN = {
    "whole": lambda calibration, here, descent: calibration.accumulate(here, descent),
    "low-passed": lambda calibration, here, descent: calibration._softened(here, descent)[0],
}


@pytest.mark.parametrize("how", SEEN)
def test_clipped_noise_enlarges_shadows_and_no_longer_does(how: str, monkeypatch: pytest.MonkeyPatch) -> None:
    rest, error = plate_turned_by_noise(SEEN[how])
    assert abs(rest) < 3 * error, (rest, error)
    monkeypatch.setattr("splatcore.calibration.clipping", lambda *_: Clipping(0.0))
    mean, error = plate_turned_by_noise(SEEN[how])
    assert mean > 5 * error, (mean, error)
    rest, error = plate_turned_by_noise(SEEN[how], clipped=False)
    assert abs(rest) < 3 * error, (rest, error)


def test_clipped_noise_feeds_no_fog_in_binned_pixels(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    volume = phantom(32)
    simulate(volume, tmp_path, Simulation(views=30, det=64, noise="r2", seed=2), threads=1, name="object")
    scan, air = read_scan(tmp_path), binary_erosion(volume == 0, iterations=4)
    options = Options(quality="preview", rotation="given", calibrate="none", threads=1)

    def fog() -> float:
        return float(drain(reconstruct(scan, options)).splats.voxelize(scan.volume, 1)[air].mean())

    without = fog()
    monkeypatch.setattr("splatcore.calibration.clipping", lambda *_: Clipping(0.0))
    assert without < 0.2 * fog()


def test_large_views_are_sampled() -> None:
    """Every fourth row of these: the others would say that hardly any pixel amid zeros is positive."""
    view = np.maximum(air(0.05, (1, 1024, 1024)), 0)
    view[:, np.arange(1024) % 4 != 0] = 0
    assert clipping(np.repeat(view, 16, axis=0), None).deviation == pytest.approx(0.05, rel=0.06)


def test_unclear_turns_wait_in_the_first_quarter_of_a_level(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    simulate(phantom(32), tmp_path, Simulation(views=30, det=96, sigma_rot=0.02, seed=2), threads=1, name="object")
    swept: dict[int, list[bool]] = {}
    sweep = Calibration.sweep

    def spy(self: Calibration, here: Level, descent: Any, finest: int, waiting: bool = False) -> dict[str, float]:
        swept.setdefault(here.factor, []).append(waiting)
        return sweep(self, here, descent, finest, waiting)

    told: list[bool] = []

    def step(*given: Any) -> Any:
        told.append(given[-1])
        return step_full(*given)

    monkeypatch.setattr(Calibration, "sweep", spy)
    monkeypatch.setattr("splatcore.calibration.step_full", step)
    options = Options(quality="preview", rotation="given", gate="off", threads=1)
    drain(reconstruct(read_scan(tmp_path), options))
    coarsest, *others = sorted(swept, reverse=True)
    assert not any(swept[coarsest])
    assert others
    for factor in others:
        often = swept[factor]
        assert often == sorted(often, reverse=True)
        assert 0.1 < sum(often) / len(often) < 0.3
    assert sum(told) == sum(map(sum, swept.values()))
