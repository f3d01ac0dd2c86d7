"""Geometries as users have them: each is reconstructed, and fails without what was built for it.

The object is the phantom in a cube of 200 mm; scores are of the part that all views see, in its own units."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from splatcore.errors import OptionsError
from splatcore.gauge import align, pose_errors, settle
from splatcore.geometry import Beam, Frames, RigidMotions, circular
from splatcore.grid import VolumeGrid, grid_from_view
from splatcore.options import Options
from splatcore.planar import common_plane
from splatcore.posefile import frames_for
from splatcore.pyramid import factors, level
from splatcore.reconstruct import drain, reconstruct
from splatcore.reconstruction import Reconstruction
from splatcore.results import write_results
from splatcore.scan import Scan
from splatcore.simulate import add_noise, project

from .phantom import phantom

EDGE, UNIT = 40, 0.01
CUBE = VolumeGrid((EDGE,) * 3, (200 / EDGE,) * 3)
FIXED = Options(calibrate="none", threads=1)
FREE = Options(calibrate="full", threads=1)


def even(views: int, arc: float = 360.0) -> NDArray[np.float64]:
    return np.arange(views) * arc / views


def orbit(
    angles: NDArray[np.float64], rows: int = 64, cols: int = 64, pixel: tuple[float, float] = (6.0, 6.0),
    offset_u: float = 0.0, beam: Beam = "cone",
) -> Frames:  # fmt: skip
    return circular(beam, angles, 500, 700, rows, cols, pixel, (0.0, offset_u))


def scan_of(nominal: Frames, true: Frames | None = None, grid: VolumeGrid = CUBE, seed: int = 0) -> Scan:
    """R2 noise; the object is the whole phantom, whatever the grid."""
    images = project(phantom(EDGE) * np.float32(UNIT), CUBE, true or nominal, 1)
    return Scan("phantom", add_noise(images, "r2", 1e4, 10.0, np.random.default_rng(seed)), nominal, grid)


def jitter(frames: Frames, rotation: float = 0.02, shift: float = 3.0, seed: int = 1) -> Frames:
    """Views moved by so much per axis, rad and mm; those of a line detector in their plane."""
    rng = np.random.default_rng(seed)
    omega, tau = rng.normal(0, rotation, (len(frames), 3)), rng.normal(0, shift, (len(frames), 3))
    if frames.line:
        omega[:, :2] = tau[:, 2] = 0
    return RigidMotions.exp(omega, tau).correct(frames)


def psnr(result: Reconstruction, true: Frames, radius: float = 95.0, height: float = 95.0) -> float:
    """Aligned, inside a cylinder (mm) about the axis."""
    similarity, _ = align(true, result.corrected)
    volume = result.splats.moved(similarity).voxelize(CUBE, 1)
    x, y, z = np.moveaxis(CUBE.centers_mm(), -1, 0)
    inside = (np.hypot(x, y) < radius) & (np.abs(z) < height)
    error = (volume / UNIT - phantom(EDGE))[inside]
    return float(-10 * np.log10(np.mean(error.astype(np.float64) ** 2)))


def errors(true: Frames, found: Frames) -> tuple[float, float]:
    """Aligned RMS over views, degrees and mm."""
    omega, tau = pose_errors(true, align(true, found)[1]).vectors()
    return float(np.rad2deg(np.sqrt((omega**2).sum(1).mean()))), float(np.sqrt((tau**2).sum(1).mean()))


PREVIEW_FIXED, PREVIEW_FREE = replace(FIXED, quality="preview"), replace(FREE, quality="preview")
OBLONG = {"rows": 60, "cols": 42, "pixel": (6.4, 9.0)}
IRREGULAR = np.sort(np.random.default_rng(2).uniform(0, 360, 40))


@pytest.mark.parametrize(
    "frames",
    [
        orbit(even(36, 215)),
        # 17 mm beyond the axis on one side, all on the other
        pytest.param(orbit(even(60), cols=36, offset_u=84.0), marks=pytest.mark.slow),
        pytest.param(orbit(even(40), **OBLONG), marks=pytest.mark.slow),
        pytest.param(orbit(IRREGULAR), marks=pytest.mark.slow),
        pytest.param(orbit(even(36, 180), pixel=(4.5, 4.5), beam="parallel"), marks=pytest.mark.slow),
    ],
    ids=["short scan", "half fan", "oblong pixels", "irregular angles", "parallel half turn"],
)
def test_poses_are_found_in_every_geometry(frames: Frames) -> None:
    true = jitter(frames)
    scan = scan_of(frames, true)
    result = drain(reconstruct(scan, PREVIEW_FREE))
    before, after = errors(true, frames), errors(true, result.corrected)
    assert before[0] > 1.5 and before[1] > 4
    assert after[0] < 1.3 and after[1] < 0.7  # observed at most 1.13 degrees (a pixel of the level is 2.5) and 0.47 mm
    assert psnr(result, true) > psnr(drain(reconstruct(scan, PREVIEW_FIXED)), true) + 1.0  # observed at least 1.19 dB


def test_frames_of_any_kind() -> None:
    """A saddle-shaped orbit, the images stored transposed and mirrored, distances that differ from view to view."""
    plain = orbit(even(40))
    angle = np.deg2rad(even(40))
    rise = np.stack([0 * angle, 0 * angle, 45 * np.sin(2 * angle)], axis=1)
    near = 1 + 0.1 * np.cos(3 * angle)[:, None]
    frames = replace(plain, source=near * plain.source + rise, u=plain.v, v=-plain.u)
    result = drain(reconstruct(scan_of(frames), PREVIEW_FIXED))
    assert psnr(result, frames) > 26.5  # on the plain orbit 27.2


def test_a_detector_too_narrow_for_the_object() -> None:
    """The object is 124 mm wide, what all views see 103 mm, the volume asked for 200 mm."""
    frames = orbit(even(40), cols=24)
    result = drain(reconstruct(scan_of(frames), PREVIEW_FIXED))
    assert psnr(result, frames, radius=40) > 24.1  # 24.7; 23.4 where the corners start with what FDK smears there


@pytest.mark.slow
def test_a_volume_smaller_than_the_object() -> None:
    frames = orbit(even(40))
    part = VolumeGrid((20,) * 3, CUBE.voxel_mm)
    whole = drain(reconstruct(scan_of(frames), PREVIEW_FIXED))
    inner = drain(reconstruct(scan_of(frames, grid=part), PREVIEW_FIXED))
    assert inner.volume.shape == (20, 20, 20)
    assert psnr(inner, frames, 45, 45) > psnr(whole, frames, 45, 45) - 1


def fan(beam: Beam, views: int = 60) -> tuple[Scan, Frames]:
    """One row of 96 pixels through one slice of the phantom, views moved in its plane; the scan and its truth."""
    slice_ = np.ascontiguousarray(phantom(EDGE)[13:14] * np.float32(UNIT))
    grid = VolumeGrid((1, EDGE, EDGE), CUBE.voxel_mm)
    pixel = 4.0 if beam == "cone" else 2.9
    nominal = orbit(even(views), rows=1, cols=96, pixel=(pixel, pixel), beam=beam)
    true = jitter(nominal)
    images = add_noise(project(slice_, grid, true, 1), "r2", 1e4, 10.0, np.random.default_rng(0))
    return Scan("fan", images, nominal, grid), true


def slice_psnr(result: Reconstruction, true: Frames) -> float:
    similarity, _ = align(true, result.corrected)
    volume = result.splats.moved(similarity).voxelize(result.grid, 1)
    return float(-10 * np.log10(np.mean((volume / UNIT - phantom(EDGE)[13:14]).astype(np.float64) ** 2)))


@pytest.mark.slow
@pytest.mark.parametrize("beam", ["cone", "parallel"])
def test_one_row_is_calibrated_in_its_plane(beam: Beam) -> None:
    scan, true = fan(beam)
    assert factors(scan, 1) == [4, 2, 1]
    result = drain(reconstruct(scan, FREE))
    before, after = errors(true, scan.frames), errors(true, result.corrected)
    assert after[0] < 0.75 * before[0] and after[1] < 0.5 * before[1]
    fixed = slice_psnr(drain(reconstruct(scan, FIXED)), true)
    known = slice_psnr(drain(reconstruct(replace(scan, frames=true), FIXED)), true)
    assert known > fixed + 1.5  # or there is nothing to gain
    assert slice_psnr(result, true) > known - 0.35 * (known - fixed)
    omega, tau = result.corrections.vectors()
    assert np.abs(omega[:, :2]).max() < 1e-9 and np.abs(tau[:, 2]).max() < 1e-9  # no view leaves the plane
    assert np.abs(result.splats.means[:, 2]).max() < 1e-6
    assert np.isinf(result.sigma_rotation_deg[:, :2]).all() and np.isfinite(result.sigma_rotation_deg[:, 2]).all()
    assert np.isinf(result.sigma_translation_mm[:, 2]).all()


@pytest.mark.slow
def test_one_row_stored_as_one_column_gives_the_same() -> None:
    scan, _ = fan("cone")
    f = scan.frames
    column = replace(
        scan,
        projections=np.ascontiguousarray(scan.projections.transpose(0, 2, 1)),
        frames=replace(f, u=f.v, v=f.u, rows=f.cols, cols=1),
    )
    assert level(column, 4).images.shape == (60, 24, 1)
    one, other = (drain(reconstruct(s, PREVIEW_FREE)) for s in (scan, column))
    assert np.abs(one.volume - other.volume).mean() < 0.1 * one.volume.mean()


@pytest.mark.slow
def test_one_column_along_the_axis_does_not_crash() -> None:
    frames = orbit(even(20), rows=48, cols=1, pixel=(6.0, 6.0))
    assert common_plane(frames) is None
    result = drain(reconstruct(scan_of(frames), PREVIEW_FREE))
    assert np.isfinite(result.volume).all() and np.isfinite(result.corrected.source).all()


def test_a_single_pixel_cannot_be_calibrated() -> None:
    with pytest.raises(OptionsError, match="1 x 1"):
        drain(reconstruct(scan_of(orbit(even(20), rows=1, cols=1)), FREE))


def test_the_gauge_of_one_row_stays_in_its_plane() -> None:
    """Four freedoms of a fan beam: a turn, two shifts and the magnification; the projections do not change by them."""
    scan, _ = fan("cone")
    rng = np.random.default_rng(3)
    omega, tau = rng.normal(0, 0.02, (60, 3)) + 0.1, rng.normal(0, 2, (60, 3)) + 5
    omega[:, :2] = tau[:, 2] = 0
    moved = RigidMotions.exp(omega, tau)
    similarity, settled = settle(scan.frames, moved)
    vector, shift = settled.vectors()
    assert np.abs(vector[:, :2]).max() < 1e-12 and np.abs(shift[:, 2]).max() < 1e-9
    assert abs(vector[:, 2].mean()) < 1e-12 and similarity.scale != 1
    points = np.array([[10.0, -20, 0], [30, 5, 0], [-25, 15, 0]])
    world = similarity.scale * points @ similarity.rotation.T + similarity.translation
    assert np.allclose(moved.correct(scan.frames).project(points), settled.correct(scan.frames).project(world))


def test_bad_pixels_do_not_get_into_coarser_levels() -> None:
    scan = scan_of(orbit(even(8)))
    bad = np.zeros((64, 64), bool)
    bad[10:20:3, 11:50:2] = True  # never a whole block of 2 x 2
    spoiled = scan.projections.copy()
    spoiled[:, bad] = 7.0
    here = level(replace(scan, projections=spoiled, bad_pixels=bad), 2)
    clean = np.where(bad, np.nan, scan.projections).reshape(8, 32, 2, 32, 2)
    np.testing.assert_allclose(here.images, np.nanmean(clean, axis=(2, 4)), rtol=1e-5, atol=1e-6)


@pytest.mark.slow
def test_dead_lines_of_the_detector() -> None:
    frames = orbit(even(40))
    scan = scan_of(frames)
    bad = np.zeros((64, 64), bool)
    bad[:, 30] = bad[20, 10:50] = bad[40:44, 38:42] = True
    spoiled = scan.projections.copy()
    spoiled[:, bad] = 0.0
    told = drain(reconstruct(replace(scan, projections=spoiled, bad_pixels=bad), PREVIEW_FIXED))
    untold = drain(reconstruct(replace(scan, projections=spoiled), PREVIEW_FIXED))
    whole = drain(reconstruct(scan, PREVIEW_FIXED))
    assert psnr(told, frames) > psnr(whole, frames) - 0.7
    assert psnr(untold, frames) < psnr(whole, frames) - 2


@pytest.mark.slow
def test_the_poses_of_an_earlier_scan_serve_the_next(tmp_path: Path) -> None:
    """The scanner is as wrong as before, but for a little: its poses make up for calibration, or help it."""
    nominal = orbit(even(36))
    first = jitter(nominal, 0.03, 4.0, seed=1)
    second = jitter(first, 0.004, 0.4, seed=2)
    write_results(drain(reconstruct(scan_of(nominal, first), PREVIEW_FREE)), tmp_path)
    scan = scan_of(nominal, second, seed=5)
    helped = replace(scan, frames=frames_for(nominal, tmp_path / "poses.json"))
    before, after = errors(second, nominal), errors(second, helped.frames)
    assert after[0] < 0.35 * before[0] and after[1] < 0.2 * before[1]  # 0.65 of 2.6 degrees, 0.7 of 6.8 mm
    without, at_once = (psnr(drain(reconstruct(s, PREVIEW_FIXED)), second) for s in (scan, helped))
    assert at_once > without + 1.2
    again = drain(reconstruct(helped, PREVIEW_FREE))
    assert psnr(again, second) > at_once and errors(second, again.corrected)[1] < after[1]


def test_the_field_of_view_of_a_half_fan_is_its_longer_side() -> None:
    frames = orbit(even(60), cols=36, offset_u=84.0)
    grid = grid_from_view(frames)
    longer = (84 + 18 * 6) / 700 * 500
    assert grid.half_extent_mm()[0] == pytest.approx(longer, rel=0.08)
