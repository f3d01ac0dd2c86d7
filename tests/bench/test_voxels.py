"""Voxels moved by a similarity are what the moved splats voxelise to."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from bench.paper.rtk.remote import RTK
from bench.paper.runners import needle_share
from bench.paper.scans import ScanSpec, make_scan
from bench.paper.voxels import resampled, score
from splatcore.evaluate import read_truth
from splatcore.gauge import moved_frames
from splatcore.geometry import rotation_from_vector
from splatcore.grid import VolumeGrid
from splatcore.splats import Similarity, Splats

GRID = VolumeGrid((20, 24, 22), (2.0, 1.8, 2.2), (1.0, -2.0, 3.0))
MOVE = Similarity(rotation_from_vector(np.array([0.1, -0.15, 0.2])), np.array([1.5, -1.0, 2.0]), 1.04)
NOTHING = Similarity(np.eye(3), np.zeros(3))


def blobs() -> Splats:
    rng = np.random.default_rng(5)
    return Splats(
        means=rng.uniform(-8, 8, (6, 3)).astype(np.float32) + np.float32([1, -2, 3]),
        scales=rng.uniform(4, 6, (6, 3)).astype(np.float32),
        quats=rng.normal(size=(6, 4)).astype(np.float32),
        density=rng.uniform(0.01, 0.02, 6).astype(np.float32),
    )


def test_resampling_agrees_with_moving_the_splats() -> None:
    splats = blobs()
    by_voxels = resampled(splats.voxelize(GRID, 1), GRID, MOVE)
    by_splats = splats.moved(MOVE).voxelize(GRID, 1)
    inside = (slice(4, -4),) * 3  # what was outside the volume cannot be moved into it
    error = np.abs(by_voxels - by_splats)[inside].max() / by_splats.max()
    unmoved = np.abs(splats.voxelize(GRID, 1) - by_splats)[inside].max() / by_splats.max()
    assert error < 0.005 and unmoved > 0.1


def test_no_motion_changes_no_voxel() -> None:
    volume = np.random.default_rng(0).random(GRID.shape).astype(np.float32)
    np.testing.assert_allclose(resampled(volume, GRID, NOTHING), volume, atol=2e-6)


def test_scores_see_through_the_gauge(tmp_path: Path, data: Path) -> None:
    """The truth in a world of its own, with frames that belong there: aligned scores are nearly those of the truth."""
    folder = make_scan(ScanSpec("teapot", edge=24, views=12), tmp_path, data, 1, RTK())
    header, truth, _, true = read_truth(folder)
    assert header.volume is not None
    perfect = score(truth, true, header.volume, folder)
    assert perfect["psnr"] == np.inf and perfect["psnr_aligned"] > 90 and perfect["rpe_px_aligned"] < 1e-6
    move = Similarity(rotation_from_vector(np.array([0.0, 0.0, 0.05])), np.array([1.0, 0.0, -2.0]), 1.01)
    moved = score(resampled(truth, header.volume, move), moved_frames(true, move), header.volume, folder)
    assert moved["rot_deg"] == pytest.approx(np.rad2deg(0.05), rel=0.01)
    assert moved["rot_deg_aligned"] < 1e-6 and moved["trans_vox_aligned"] < 1e-6
    assert moved["psnr_aligned"] > moved["psnr"] + 3


def test_needles_are_counted_by_their_longest_and_shortest_axis() -> None:
    scales = np.float32([[1, 1, 1], [11, 1, 5], [9, 1, 1], [1, 0.5, 5.1]])
    n = len(scales)
    splats = Splats(np.zeros((n, 3), np.float32), scales, np.ones((n, 4), np.float32), np.ones(n, np.float32))
    assert needle_share(splats) == 0.5
