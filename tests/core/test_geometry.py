"""Laws of frames, rigid motions and the gauge."""

from __future__ import annotations

import numpy as np
import pytest

from splatcore.gauge import align, mean_rotation, moved_frames, pose_errors, settle
from splatcore.geometry import (
    Array,
    Beam,
    Frames,
    RigidMotions,
    circular,
    rotation_from_vector,
    vector_from_rotation,
)
from splatcore.splats import Similarity, Splats

from . import scenes

BEAMS = pytest.mark.parametrize("beam", ["cone", "parallel"])
VIEWS = 9


def motions(seed: int, turn: float = 0.3, shift: float = 5.0) -> RigidMotions:
    rng = np.random.default_rng(seed)
    return RigidMotions.exp(rng.normal(0, turn, (VIEWS, 3)), rng.normal(0, shift, (VIEWS, 3)))


def orbit(beam: Beam) -> Frames:
    return scenes.frames(beam, views=VIEWS)


def moved_points(motion: RigidMotions, points: Array) -> Array:
    """[views, n, 3]"""
    return np.einsum("vij,nj->vni", motion.rotation, points) + motion.translation[:, None]


def points(n: int = 30) -> Array:
    return np.random.default_rng(9).uniform(-60, 60, (n, 3))


def close(a: RigidMotions, b: RigidMotions, atol: float = 1e-12) -> bool:
    return bool(
        np.allclose(a.rotation, b.rotation, rtol=0, atol=atol)
        and np.allclose(a.translation, b.translation, rtol=0, atol=100 * atol)
    )


# ---- rotations -------------------------------------------------------------------------------------


@pytest.mark.parametrize("angle", [0.0, 1e-300, 1e-12, 1e-7, 1e-3, 1.0, 3.0, np.pi - 1e-4, np.pi - 1e-9])
def test_log_undoes_exp(angle: float) -> None:
    axes = np.random.default_rng(0).normal(size=(200, 3))
    vectors = angle * axes / np.linalg.norm(axes, axis=1, keepdims=True)
    back = vector_from_rotation(rotation_from_vector(vectors))
    np.testing.assert_allclose(back, vectors, rtol=1e-7, atol=1e-14)


def test_half_turns_have_two_vectors() -> None:
    axes = np.concatenate([np.eye(3), np.random.default_rng(0).normal(size=(50, 3))])
    vectors = np.pi * axes / np.linalg.norm(axes, axis=1, keepdims=True)
    matrices = rotation_from_vector(vectors)
    back = vector_from_rotation(matrices)
    np.testing.assert_allclose(np.linalg.norm(back, axis=1), np.pi, rtol=1e-12)
    np.testing.assert_allclose(rotation_from_vector(back), matrices, atol=1e-12)


def test_exp_is_a_rotation_about_its_axis() -> None:
    vectors = np.random.default_rng(1).normal(size=(100, 3))
    r = rotation_from_vector(vectors)
    np.testing.assert_allclose(r @ np.swapaxes(r, 1, 2), np.broadcast_to(np.eye(3), r.shape), atol=1e-14)
    np.testing.assert_allclose(np.linalg.det(r), 1, rtol=1e-13)
    np.testing.assert_allclose(np.einsum("vij,vj->vi", r, vectors), vectors, atol=1e-14)
    quarter = rotation_from_vector(np.array([0, 0, np.pi / 2]))
    np.testing.assert_allclose(quarter @ [1, 0, 0], [0, 1, 0], atol=1e-15)


# ---- rigid motions ---------------------------------------------------------------------------------


def test_motions_are_a_group() -> None:
    a, b, c = motions(1), motions(2), motions(3)
    identity = RigidMotions.identity(VIEWS)
    assert close((a @ b) @ c, a @ (b @ c))
    assert close(a @ identity, a)
    assert close(identity @ a, a)
    assert close(a @ a.inverse(), identity)
    assert close(a.inverse() @ a, identity)
    assert close((a @ b).inverse(), b.inverse() @ a.inverse())
    assert close(RigidMotions.exp(*a.vectors()), a)


def test_product_moves_by_the_second_first() -> None:
    a, b, x = motions(1), motions(2), points()
    twice = np.einsum("vij,vnj->vni", a.rotation, moved_points(b, x)) + a.translation[:, None]
    np.testing.assert_allclose(moved_points(a @ b, x), twice, atol=1e-11)


@BEAMS
def test_corrected_frames_see_x_as_nominal_ones_see_the_moved_x(beam: Beam) -> None:
    nominal, a, x = orbit(beam), motions(4), points()
    seen = a.correct(nominal).project(x)
    for view in range(VIEWS):
        expected = nominal[view : view + 1].project(moved_points(a, x)[view])[0]
        np.testing.assert_allclose(seen[view], expected, atol=1e-9)


@BEAMS
def test_corrections_compose_and_can_be_found_again(beam: Beam) -> None:
    nominal, a, b = orbit(beam), motions(5), motions(6)
    x = points()
    np.testing.assert_allclose((a @ b).correct(nominal).project(x), b.correct(a.correct(nominal)).project(x), atol=1e-9)
    found, expected = pose_errors(nominal, a.correct(nominal)), a.translation
    if beam == "parallel":  # a shift along the ray cannot be found
        ray = nominal.source
        expected = expected - np.sum(expected * ray, axis=1, keepdims=True) * ray
    assert close(found, RigidMotions(a.rotation, expected), 1e-11)


# ---- frames ----------------------------------------------------------------------------------------


@BEAMS
def test_a_pixels_own_point_projects_onto_it(beam: Beam) -> None:
    """Detector points, and whatever lies on their rays."""
    frames = orbit(beam)
    row, col = np.meshgrid(np.arange(frames.rows), np.arange(frames.cols), indexing="ij")
    for view in range(VIEWS):
        one = frames[view : view + 1]
        away_c, away_r = (col - (frames.cols - 1) / 2)[..., None], (row - (frames.rows - 1) / 2)[..., None]
        pixel = (one.detector_center[0] + away_c * one.u[0] + away_r * one.v[0]).reshape(-1, 3)
        along = one.source[0] - pixel if beam == "cone" else -700 * one.source[0]
        for share in (0.0, 0.4):
            seen = one.project(pixel + share * along)[0]
            np.testing.assert_allclose(seen, np.stack([col, row], -1).reshape(-1, 2), atol=1e-9)


@BEAMS
@pytest.mark.parametrize("factor", [1, 2, 3, 5])
def test_binned_pixels_lie_in_the_middle_of_their_blocks(beam: Beam, factor: int) -> None:
    frames = orbit(beam)
    small = frames.binned(factor)
    assert (small.rows, small.cols) == (frames.rows // factor, frames.cols // factor)
    where, binned = frames.project(points()), small.project(points())
    np.testing.assert_allclose(binned * factor + (factor - 1) / 2, where, atol=1e-9)


def test_the_circular_orbit_is_as_the_page_says() -> None:
    angles = np.array([0.0, 90.0, 200.0])
    frames = circular("cone", angles, 500, 700, 10, 20, (2.0, 1.5), (4.0, 3.0))
    np.testing.assert_allclose(frames.source[0], [500, 0, 0], atol=1e-12)
    np.testing.assert_allclose(frames.source[1], [0, 500, 0], atol=1e-12)
    np.testing.assert_allclose(frames.detector_center[0], [-200, 3, -4], atol=1e-12)
    np.testing.assert_allclose(frames.u[1], [-1.5, 0, 0], atol=1e-12)
    np.testing.assert_allclose(frames.v, [[0, 0, -2.0]] * 3, atol=1e-12)
    # The axis appears at (cols - 1) / 2 - offset_u / pitch.
    np.testing.assert_allclose(frames.project(np.zeros((1, 3)))[:, 0, 0], 9.5 - 3.0 / 1.5, atol=1e-12)
    ray = circular("parallel", angles, 500, 700, 10, 20, (2.0, 1.5)).source
    np.testing.assert_allclose(ray, -frames.source / 500, atol=1e-15)


@BEAMS
def test_axes_and_shift(beam: Beam) -> None:
    frames = orbit(beam)
    axes = frames.axes()
    np.testing.assert_allclose(axes @ np.swapaxes(axes, 1, 2), np.broadcast_to(np.eye(3), axes.shape), atol=1e-14)
    np.testing.assert_allclose(np.linalg.det(axes), 1, rtol=1e-13)
    shifted = frames.shifted_detector(1.5, -2.0).project(points())
    np.testing.assert_allclose(shifted, frames.project(points()) - [1.5, -2.0], atol=1e-9)
    packed = frames.packed()
    assert packed.shape == (VIEWS, 4, 3)
    assert packed.flags.c_contiguous


# ---- the gauge -------------------------------------------------------------------------------------


def similarity(seed: int, beam: Beam) -> Similarity:
    rng = np.random.default_rng(seed)
    scale = 1.07 if beam == "cone" else 1.0
    return Similarity(rotation_from_vector(rng.normal(0, 0.3, 3)), rng.normal(0, 10, 3), scale)


def placed(s: Similarity, x: Array) -> Array:
    return s.scale * x @ s.rotation.T + s.translation


@BEAMS
def test_moved_frames_see_the_moved_world_alike(beam: Beam) -> None:
    frames, s, x = orbit(beam), similarity(1, beam), points()
    np.testing.assert_allclose(moved_frames(frames, s).project(placed(s, x)), frames.project(x), atol=1e-9)


@BEAMS
def test_settling_changes_no_projection_and_zeroes_the_mean_rotation(beam: Beam) -> None:
    nominal, x = orbit(beam), points()
    before = motions(7)
    s, after = settle(nominal, before)
    was, now = before.correct(nominal).project(x), after.correct(nominal).project(placed(s, x))
    np.testing.assert_allclose(now, was, atol=1e-8)
    np.testing.assert_allclose(after.vectors()[0].mean(axis=0), 0, atol=1e-13)


@BEAMS
def test_settled_poses_are_the_nearest_to_nominal(beam: Beam) -> None:
    """No further shift or magnification of the world brings the translations nearer to zero, and settling twice
    does nothing more."""
    nominal = orbit(beam)
    _, once = settle(nominal, motions(8))
    again, twice = settle(nominal, once)
    np.testing.assert_allclose(again.rotation, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(again.translation, 0, atol=1e-9)
    assert again.scale == pytest.approx(1, abs=1e-12)
    assert close(once, twice, 1e-11)
    least = np.sum(once.translation**2)
    for k in range(3):
        for sign in (-1, 1):
            shift = sign * 0.1 * np.eye(3)[k]
            # The world moved by `shift`: tau' = tau - R shift.
            other = once.translation - np.einsum("vij,j->vi", once.rotation, shift)
            if beam == "parallel":
                other -= np.sum(other * nominal.source, axis=1, keepdims=True) * nominal.source
            assert np.sum(other**2) > least
    if beam == "cone":
        for scale in (0.999, 1.001):
            other = scale * once.translation + (1 - scale) * nominal.source
            assert np.sum(other**2) > least


@BEAMS
def test_align_recovers_a_known_similarity(beam: Beam) -> None:
    """The estimate is the truth in another world; aligned, all its errors are gone."""
    true, s = orbit(beam), similarity(2, beam)
    back = Similarity(s.rotation.T, -s.rotation.T @ s.translation / s.scale, 1 / s.scale)
    found, aligned = align(true, moved_frames(true, back))
    np.testing.assert_allclose(found.rotation, s.rotation, atol=1e-9)
    np.testing.assert_allclose(found.translation, s.translation, atol=1e-6)
    assert found.scale == pytest.approx(s.scale, abs=1e-9)
    errors = pose_errors(true, aligned)
    assert np.abs(errors.vectors()[0]).max() < 1e-9
    assert np.abs(errors.translation).max() < 1e-6


def test_mean_rotation_of_rotations_about_one() -> None:
    center = rotation_from_vector(np.array([0.5, -1.0, 0.7]))
    spread = rotation_from_vector(np.random.default_rng(3).normal(0, 0.2, (50, 3)))
    symmetric = np.concatenate([spread @ center, np.swapaxes(spread, 1, 2) @ center])
    np.testing.assert_allclose(mean_rotation(symmetric), center, atol=1e-12)


def test_moved_splats_are_the_moved_object() -> None:
    """Means, covariances and density of x -> s Q x + t."""
    splats, s = Splats(*(a.astype(np.float32) for a in scenes.cloud(20).numpy())), similarity(3, "cone")
    moved = splats.moved(s)

    def covariance(of: Splats) -> Array:
        w, x, y, z = (of.quats / np.linalg.norm(of.quats, axis=1, keepdims=True)).T.astype(np.float64)
        r = np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
            ]
        )
        return np.einsum("ijn,nj,kjn->nik", r, of.scales.astype(np.float64) ** 2, r)

    np.testing.assert_allclose(moved.means, placed(s, splats.means), rtol=1e-5, atol=1e-4)
    expected = s.scale**2 * s.rotation @ covariance(splats) @ s.rotation.T
    np.testing.assert_allclose(covariance(moved), expected, atol=1e-5 * np.abs(expected).max())
    np.testing.assert_allclose(moved.density * s.scale, splats.density, rtol=1e-6)
