"""Projection matching: its one step against known answers, and the whole on a small scan."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from splatcore.gauge import align, pose_errors
from splatcore.geometry import Frames
from splatcore.grid import VolumeGrid
from splatcore.matching import Schedule, _refined, gauss_newton, match
from splatcore.scan import Scan
from splatcore.simulate import Simulation

from .phantom import scan_of


def true_frames(scan: Scan) -> Frames:
    assert scan.simulation is not None
    given = scan.simulation["frames"]
    keys = ("source", "detector_center", "u", "v")
    return replace(scan.frames, **{key: np.array([frame[key] for frame in given]) for key in keys})


def errors(true: Frames, found: Frames) -> tuple[float, float]:
    """RMS angle (rad) and length (mm) after alignment."""
    omega, tau = pose_errors(true, align(true, found)[1]).vectors()
    return float(np.sqrt((omega**2).sum(axis=1).mean())), float(np.sqrt((tau**2).sum(axis=1).mean()))


def test_a_linear_problem_is_solved_in_one_step() -> None:
    rng = np.random.default_rng(0)
    derivative, wanted = rng.normal(0, 1, (6, 400)), rng.normal(0, 0.1, 6)
    residual = -(wanted @ derivative) + rng.normal(0, 1e-4, 400)
    step = gauss_newton(derivative, residual, np.zeros(6), np.full(6, 1e6), np.full(6, 10.0))
    np.testing.assert_allclose(step, wanted, atol=5e-5)


def test_without_images_the_prior_pulls_home() -> None:
    offset = np.array([0.1, -0.2, 0.3, 1.0, 2.0, -3.0])
    step = gauss_newton(np.zeros((6, 10)), np.ones(10), offset, np.full(6, 0.5), np.full(6, 10.0))
    np.testing.assert_allclose(step, -offset, rtol=1e-12)


def test_a_long_step_is_shortened_as_a_whole() -> None:
    derivative = np.eye(6)
    residual = -np.array([8.0, 4.0, 0, 0, 0, 1.0])
    step = gauss_newton(derivative, residual, np.zeros(6), np.full(6, 1e9), np.full(6, 2.0))
    np.testing.assert_allclose(step, [2, 1, 0, 0, 0, 0.25], atol=1e-9)


def test_a_refined_volume_lies_where_the_coarse_one_did() -> None:
    """A linear function of position stays the same function, away from the border; also where sizes are odd."""
    coarse, fine = VolumeGrid((5, 6, 4), (4.0, 4.0, 4.0)), VolumeGrid((9, 12, 8), (2.0, 2.0, 2.0))

    def ramp(grid: VolumeGrid) -> np.ndarray:
        return (grid.centers_mm() @ np.array([1.0, -2.0, 0.5])).astype(np.float32)

    inner = (slice(1, -1),) * 3
    np.testing.assert_allclose(_refined(ramp(coarse), fine)[inner], ramp(fine)[inner], atol=1e-4)


def test_poses_are_found(tmp_path: Path) -> None:
    scan = scan_of(tmp_path, Simulation(views=24, det=64, sigma_rot=0.06, sigma_trans=1.0, seed=3), edge=32)
    true = true_frames(scan)
    _, motions = match(scan, 1, Schedule(rounds=((2, 6), (1, 2)), last=1))
    before, after = errors(true, scan.frames), errors(true, motions.correct(scan.frames))
    # 6.4 degrees and 1.8 voxels before; 2.7 and 0.22 observed
    assert after[0] < 0.6 * before[0] and after[1] < 0.25 * before[1]
    omega, _ = motions.vectors()
    assert np.abs(omega.mean(axis=0)).max() < 1e-9  # settled


def test_right_poses_stay_near(tmp_path: Path) -> None:
    """On an object nearly round, at 32 pixels: 0.3 degrees and 0.13 voxels observed."""
    scan = scan_of(tmp_path, Simulation(views=24, det=64, noise="none"), edge=32)
    volume, motions = match(scan, 1, Schedule(rounds=((2, 6),), last=1, caution=1000.0))
    assert volume.shape == scan.volume.shape
    rotation, translation = errors(scan.frames, motions.correct(scan.frames))
    assert np.rad2deg(rotation) < 0.6 and translation < 0.25 * scan.volume.voxel_mm[0]
