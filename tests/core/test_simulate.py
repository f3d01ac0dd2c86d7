"""Simulated scans: unbiased draws, the stated noise, and frames that mean what scan.json's readers think."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from splatcore.errors import ResultError
from splatcore.geometry import circular, rotation_from_vector
from splatcore.scan import check_scan, read_scan
from splatcore.simulate import Simulation, add_noise, draw_drift, draw_motions, load_volume, simulate, true_frames

from .phantom import phantom


def nominal(views: int = 12):
    return circular("cone", np.arange(views) * 360 / views, 500, 700, 64, 64, (6.25, 6.25))


def test_draws_are_unbiased_and_of_the_stated_width():
    motions = draw_motions(20_000, 0.03, 1.5, np.random.default_rng(0))
    omega, tau = motions.vectors()
    for values, sigma in ((omega, 0.03), (tau, 1.5)):
        assert np.abs(values.mean(axis=0)).max() < 4 * sigma / np.sqrt(20_000)
        assert np.abs(values.std(axis=0) / sigma - 1).max() < 4 / np.sqrt(2 * 20_000)
    correlation = np.corrcoef(np.concatenate([omega, tau], axis=1).T) - np.eye(6)
    assert np.abs(correlation).max() < 5 / np.sqrt(20_000)


@pytest.mark.parametrize("axes", ["camera", "turntable"])
def test_drift_is_smooth_in_its_axes_and_as_large_as_stated(axes):
    frames, what = nominal(90), Simulation(views=90, drift_rot_deg=1.5, drift_trans_vox=2.0, drift_axes=axes)
    omega, tau = draw_drift(frames, what, 1.5, np.random.default_rng(7)).vectors()
    for part, size in ((omega, np.deg2rad(1.5)), (tau, 3.0)):
        assert np.sqrt((part**2).sum(axis=1).mean()) == pytest.approx(size, rel=1e-6)
        own = np.einsum("vij,vj->vi", frames.axes(), part) if axes == "camera" else part
        assert np.abs(own.mean(axis=0)).max() < 1e-9  # a constant would be a static error
        # Three half waves over 90 views: no step larger than 3 pi / 90 of the largest possible amplitude.
        assert np.abs(np.diff(own, axis=0)).max() < 0.25 * size


def test_drift_leaves_other_draws_alone():
    frames, jitter = nominal(), Simulation(views=12, sigma_rot=0.02, sigma_trans=1.0, seed=3)
    alone = true_frames(frames, jitter, 1.5, np.random.default_rng(3))
    none = true_frames(frames, replace(jitter, drift_axes="turntable"), 1.5, np.random.default_rng(3))
    assert np.array_equal(alone.source, none.source)
    drift = replace(jitter, drift_rot_deg=1.0, drift_trans_vox=1.0)
    both = true_frames(frames, drift, 1.5, np.random.default_rng(3))
    motions = draw_motions(12, 0.02, 1.5, np.random.default_rng(3))
    expected = (draw_drift(frames, drift, 1.5, np.random.default_rng([3, 2])) @ motions).correct(frames)
    assert np.allclose(both.source, expected.source) and not np.allclose(both.source, alone.source)


def test_r2_noise_has_the_stated_mean_and_width():
    peak, level = 2.0, 1.0
    clean = np.full((400, 400), level, np.float32)
    clean[0, 0] = peak  # r2 divides by the largest value
    noisy = add_noise(clean, "r2", 1e4, 10.0, np.random.default_rng(1)).ravel()[1:]
    counts = 1e4 * np.exp(-level / peak)
    sigma = peak * np.sqrt(counts + 100) / counts
    assert noisy.mean() == pytest.approx(level + 0.5 * (sigma / peak) ** 2 * peak, abs=4 * sigma / 400)
    assert noisy.std() == pytest.approx(sigma, rel=0.01)


def test_no_noise_changes_nothing_and_noise_is_never_negative():
    clean = np.zeros((50, 50), np.float32)
    clean[10:20] = 1.0
    rng = np.random.default_rng(2)
    assert add_noise(clean, "none", 1e4, 10.0, rng) is clean
    assert add_noise(clean, "r2", 1e2, 10.0, rng).min() >= 0
    assert np.isfinite(add_noise(clean * 20, "physical", 1e2, 10.0, rng)).all()


def test_a_moved_object_is_seen_as_stated():
    """camera(x) = nominal(R x + tau): the same draw, applied to points by hand."""
    frames, what = nominal(), Simulation(views=12, sigma_rot=0.05, sigma_trans=2.0, seed=4)
    true = true_frames(frames, what, 1.5, np.random.default_rng(4))
    motions = draw_motions(12, 0.05, 3.0, np.random.default_rng(4))
    points = np.random.default_rng(0).normal(0, 40, (7, 3))
    for k in range(12):
        moved = points @ motions.rotation[k].T + motions.translation[k]
        assert np.allclose(frames[k : k + 1].project(moved), true[k : k + 1].project(points), atol=1e-9)


@pytest.mark.parametrize(
    ("what", "column", "row"),
    [
        (Simulation(views=12, offset_px=(3.0, 0.0)), -3.0, 0.0),
        (Simulation(views=12, offset_px=(0.0, 2.0)), 0.0, -2.0),
    ],
)
def test_a_detector_offset_moves_the_axis_the_other_way(what, column, row):
    true = true_frames(nominal(), what, 1.0, np.random.default_rng(0))
    assert np.allclose(true.project(np.zeros((1, 3)))[:, 0], [31.5 + column, 31.5 + row])


def test_roll_turns_the_image_about_the_detector_centre():
    frames = nominal()
    true = true_frames(frames, Simulation(views=12, roll_deg=10.0), 1.0, np.random.default_rng(0))
    points = np.array([[0.0, 0.0, 30.0]])
    before, after = frames.project(points)[:, 0] - 31.5, true.project(points)[:, 0] - 31.5
    assert np.allclose(np.linalg.norm(before, axis=1), np.linalg.norm(after, axis=1))
    assert np.allclose(np.abs(after[:, 0] / after[:, 1]), np.tan(np.deg2rad(10.0)))


def test_a_leaning_axis_stays_in_the_plane_of_the_beam():
    frames = nominal()
    true = true_frames(frames, Simulation(views=12, axis_pitch_deg=5.0), 1.0, np.random.default_rng(0))
    columns = true.project(np.array([[0.0, 0.0, 30.0], [0.0, 0.0, -30.0]]))[:, :, 0]
    assert np.allclose(columns, 31.5)  # the axis still projects onto one column
    lean = rotation_from_vector(np.deg2rad(5.0) * frames.axes()[0, 0])
    expected = frames[:1].project(np.array([[0.0, 0.0, 30.0]]) @ lean.T)
    assert np.allclose(true[:1].project(np.array([[0.0, 0.0, 30.0]])), expected)


@pytest.mark.parametrize("flips", [{"flip_u": True}, {"flip_v": True}, {"reverse": True}])
def test_images_match_their_true_frames_however_stored(tmp_path, flips):
    """The shadow of a bead lies where the true frames project it, flips and reversal included."""
    volume = np.zeros((32,) * 3, np.float32)
    volume[20, 9, 22] = 1.0
    simulate(volume, tmp_path, Simulation(views=9, det=64, noise="none", sigma_rot=0.02, sigma_trans=1.0, **flips), 1)
    scan = read_scan(tmp_path)
    true = json.loads((tmp_path / "scan.json").read_text())["simulation"]["frames"]
    x, y, z = scan.volume.axes_mm()
    bead = np.array([[x[22], y[9], z[20]]])
    for k, image in enumerate(scan.projections):
        frame = scan.frames[k : k + 1]
        frame = replace(frame, **{key: np.array([true[k][key]]) for key in ("source", "detector_center", "u", "v")})
        column, row = frame.project(bead)[0, 0]
        rows, cols = np.mgrid[0:64, 0:64]
        assert (image * cols).sum() / image.sum() == pytest.approx(column, abs=0.1)
        assert (image * rows).sum() / image.sum() == pytest.approx(row, abs=0.1)


def test_a_simulated_scan_passes_the_check_and_keeps_its_truth_apart(tmp_path):
    simulate(phantom(32), tmp_path, Simulation(views=10, det=48, sigma_rot=0.03), 1)
    assert check_scan(tmp_path).views == 10
    scan = read_scan(tmp_path)
    assert scan.frames.source[0] == pytest.approx([500, 0, 0])  # nominal, not true
    assert scan.simulation is not None and len(scan.simulation["frames"]) == 10


def test_same_seed_same_scan(tmp_path):
    what = Simulation(views=5, det=48, sigma_rot=0.03, sigma_trans=1.0, seed=7)
    for name in ("a", "b"):
        simulate(phantom(32), tmp_path / name, what, 1)
    assert np.array_equal(read_scan(tmp_path / "a").projections, read_scan(tmp_path / "b").projections)


def test_small_files_keep_a_quarter_of_the_noise(tmp_path):
    for store in ("float32", "uint16"):
        simulate(phantom(32), tmp_path / store, Simulation(views=5, det=48, store=store), 1)
    exact, small = read_scan(tmp_path / "float32").projections, read_scan(tmp_path / "uint16").projections
    assert np.abs(exact - small).max() <= exact.max() / 8000 * 1.001


def test_8_bit_volumes_are_shares_of_255(tmp_path):
    np.savez(tmp_path / "v.npz", volume=np.full((4, 4, 4), 255, np.uint8))
    assert load_volume(tmp_path / "v.npz").max() == 1.0


def test_a_full_disk_is_named(tmp_path):
    (tmp_path / "scan").mkdir()
    (tmp_path / "scan" / "projections.tif").symlink_to("/dev/full")
    with pytest.raises(ResultError, match=r"scan cannot be written to.*disk full"):
        simulate(phantom(16), tmp_path / "scan", Simulation(views=2), threads=1)
