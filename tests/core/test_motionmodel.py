"""Curves of the motion: laws of the spline, and motions that it must give back."""

from __future__ import annotations

import numpy as np
import pytest

from splatcore.geometry import RigidMotions, circular
from splatcore.motionmodel import constant_motion, smooth_motion, spline_basis

VIEWS = 45
SIGMA = np.array([0.002] * 3 + [0.1] * 3)  # rad, mm
FRAMES = circular("cone", np.arange(VIEWS) * 360 / VIEWS, 500, 700, 64, 64, (4.0, 4.0))
TIME = np.arange(VIEWS) / (VIEWS - 1)
EQUAL = np.tile(np.diag(SIGMA**-2.0), (VIEWS, 1, 1))


def motions(vectors: np.ndarray, axes: str = "turntable") -> RigidMotions:
    """[views, 6] in the named axes."""
    if axes == "camera":
        back = np.swapaxes(FRAMES.axes(), 1, 2)
        vectors = np.concatenate([np.einsum("vij,vj->vi", back, half) for half in np.split(vectors, 2, axis=1)], axis=1)
    return RigidMotions.exp(vectors[:, :3], vectors[:, 3:])


def vectors_of(what: RigidMotions) -> np.ndarray:
    return np.concatenate(what.vectors(), axis=1)


def wave() -> np.ndarray:
    """A slow motion, each component its own; ten standard deviations."""
    phase = np.arange(6) * 1.1
    return 10 * SIGMA * np.sin(2.5 * TIME[:, None] + phase)


def camera_vectors(nominal, motions):
    """(omega rad, tau mm) of every view in the axes of its nominal camera: u, v made square, u x v. [views, 6]"""
    axes = nominal.axes()
    return np.concatenate([np.einsum("vij,vj->vi", axes, part) for part in motions.vectors()], axis=1)


def test_basis_is_a_partition_of_unity_and_nowhere_negative():
    time = np.random.default_rng(0).uniform(-3, 8, 200)
    basis = spline_basis(time, 7)
    assert basis.shape == (200, 10)
    assert np.abs(basis.sum(axis=1) - 1).max() < 1e-12 and basis.min() >= 0
    assert (np.count_nonzero(basis, axis=1) <= 4).all()  # cubic: four at a time


def test_basis_holds_every_cubic():
    basis = spline_basis(TIME, 5)
    for power in range(4):
        left = TIME**power - basis @ np.linalg.lstsq(basis, TIME**power, rcond=None)[0]
        assert np.abs(left).max() < 1e-10


def test_basis_does_not_know_when_time_began_or_what_its_unit_is():
    assert np.allclose(spline_basis(TIME, 6), spline_basis(1e6 + 3600 * TIME, 6), atol=1e-6)
    assert spline_basis(np.full(9, 4.2), 6).shape == (9, 1)  # all at one moment: a constant


@pytest.mark.parametrize("axes", ["camera", "turntable"])
def test_linear_motion_comes_back_exactly(axes):
    line = np.outer(TIME - 0.3, 20 * SIGMA * [1, -1, 0.5, 2, 1, -0.3])
    curve = smooth_motion(FRAMES, motions(line, axes), EQUAL)
    assert curve.axes == axes
    assert np.abs(vectors_of(curve.motions) - vectors_of(motions(line, axes))).max(axis=0) == pytest.approx(
        np.zeros(6), abs=1e-5
    )


@pytest.mark.parametrize("axes", ["camera", "turntable"])
def test_a_curve_is_nearer_the_truth_than_the_poses_it_came_from(axes):
    true = motions(wave(), axes)
    noise = np.random.default_rng(1).normal(size=(VIEWS, 6)) * SIGMA
    found = RigidMotions.exp(noise[:, :3], noise[:, 3:]) @ true
    curve = smooth_motion(FRAMES, found, EQUAL)
    assert curve.axes == axes
    error = vectors_of(curve.motions) - vectors_of(true)
    # A constant and a slope alone would leave sqrt(2 / 45) = 0.21 of the noise; observed 0.29 and 0.31.
    assert np.sqrt((error**2 / SIGMA**2).mean()) < 0.45
    assert 12 <= curve.freedom < 60  # of 270


def test_a_view_without_information_is_predicted_from_the_others():
    true = motions(wave())
    found, known = motions(wave()), EQUAL.copy()
    found.translation[20] += 50.0
    known[20] = 0
    curve = smooth_motion(FRAMES, found, known)
    assert np.abs(curve.motions.translation[20] - true.translation[20]).max() < 0.02
    constant = constant_motion(FRAMES, found, known)
    assert np.abs(constant.motions.translation[20]).max() < 2.0


def test_what_a_view_does_not_show_is_taken_from_its_neighbours():
    """Views that do not see shifts along the ray: errors there of a hundred standard deviations change nothing."""
    true = motions(wave())
    blind, wrong = EQUAL.copy(), motions(wave())
    ray = FRAMES.source / 500.0
    for k in range(0, VIEWS, 2):
        across = np.eye(6)
        across[3:, 3:] -= np.outer(ray[k], ray[k])
        blind[k] = across @ EQUAL[k] @ across
        wrong.translation[k] += 100 * SIGMA[3] * ray[k]
    curve = smooth_motion(FRAMES, wrong, blind)
    assert np.abs(vectors_of(curve.motions) - vectors_of(true)).max(axis=0) == pytest.approx(np.zeros(6), abs=0.03)


def test_a_constant_in_camera_axes_is_found_by_all_models_and_nothing_else_is():
    shift = np.tile([0.01, 0, -0.02, 1.5, 0, 0], (VIEWS, 1))
    still = motions(shift, "camera")
    for curve in (constant_motion(FRAMES, still, EQUAL), smooth_motion(FRAMES, still, EQUAL)):
        assert np.allclose(camera_vectors(FRAMES, curve.motions), shift, atol=1e-6)
    jitter = np.random.default_rng(2).normal(size=(VIEWS, 6)) * SIGMA
    constant = constant_motion(FRAMES, motions(jitter, "camera"), EQUAL)
    assert constant.freedom == pytest.approx(6, abs=1e-5)
    assert np.allclose(camera_vectors(FRAMES, constant.motions), jitter.mean(axis=0), atol=1e-4 * SIGMA.max())


def test_an_earlier_curves_penalties_give_the_same_curve():
    noise = np.random.default_rng(3).normal(size=(VIEWS, 6)) * SIGMA
    found = motions(wave() + noise)
    first = smooth_motion(FRAMES, found, EQUAL)
    again = smooth_motion(FRAMES, found, EQUAL, like=first)
    assert np.array_equal(vectors_of(again.motions), vectors_of(first.motions))


def test_time_counts_and_not_page_order():
    """Views shuffled in the file, with their times: the same curve."""
    noise = np.random.default_rng(4).normal(size=(VIEWS, 6)) * SIGMA
    found, order = motions(wave() + noise), np.random.default_rng(5).permutation(VIEWS)
    plain = smooth_motion(FRAMES, found, EQUAL, TIME)
    shuffled = smooth_motion(
        FRAMES[order], RigidMotions(found.rotation[order], found.translation[order]), EQUAL, TIME[order]
    )
    assert np.allclose(vectors_of(shuffled.motions), vectors_of(plain.motions)[order], atol=1e-7)


@pytest.mark.parametrize("fit", [constant_motion, smooth_motion])
def test_what_no_view_shows_stays_zero(fit):
    """A fan beam: information about the turn about z and the shifts in x and y alone, zero but for rounding else."""
    flat = np.diag([0.0, 0, 1, 1, 1, 0]) @ EQUAL + 1e-18 * np.random.default_rng(2).normal(size=EQUAL.shape)
    true = wave() * [0, 0, 1, 1, 1, 0] + 2 * SIGMA * [0, 0, 1, 1, 1, 0]
    curve = vectors_of(fit(FRAMES, motions(true), flat).motions)
    assert np.abs(curve[:, [0, 1, 5]]).max() < 1e-9
    if fit is smooth_motion:
        assert np.abs(curve - true).max() < 0.3 * np.abs(true).max()
