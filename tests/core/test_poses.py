"""Gauss-Newton on poses with the object known, and the joint step with the object's strain."""

from __future__ import annotations

import numpy as np

from splatcore import _native
from splatcore.geometry import RigidMotions, circular
from splatcore.poses import Prior, accumulate, clear_directions, sigmas, step_full
from splatcore.splats import Splats

LOOSE = Prior(rotation=0.1, translation=10.0)
LIMIT = np.array([0.1] * 3 + [20.0] * 3)


def scene(views: int = 10, seed: int = 0):
    """Forty splats of a few pixels, frames, a renderer and a function that draws all views."""
    rng = np.random.default_rng(seed)
    splats = Splats(
        rng.uniform(-45, 45, (40, 3)).astype(np.float32),
        rng.uniform(4, 9, (40, 3)).astype(np.float32),
        rng.normal(size=(40, 4)).astype(np.float32),
        rng.uniform(0.002, 0.01, 40).astype(np.float32),
    )
    frames = circular("cone", np.arange(views) * 360 / views, 500, 700, 64, 64, (4.0, 4.0))
    renderer = _native.Renderer32(64, 64, 1)

    def draw(what: Splats, where) -> np.ndarray:
        images = np.empty((len(where), 64, 64), np.float32)
        for image, frame in zip(images, where.packed(), strict=True):
            renderer.render(frame, True, *what.arrays(), image)
        return images

    return splats, frames, renderer, draw


def test_known_object_gives_exact_poses_in_a_few_steps():
    splats, frames, renderer, draw = scene()
    rng = np.random.default_rng(1)
    true = RigidMotions.exp(rng.normal(0, 0.02, (10, 3)), rng.normal(0, 1.0, (10, 3)))
    images = draw(splats, true.correct(frames))
    found = RigidMotions.identity(10)
    tight = Prior(LOOSE.rotation, LOOSE.translation, strain=1e-9)  # the object is known: it may not stretch
    for _ in range(8):
        normals = accumulate(renderer, splats, found.correct(frames), images, None, 1.0)
        found, _, _ = step_full(normals, found, tight, LIMIT)
    omega, tau = (found @ true.inverse()).vectors()
    assert np.rad2deg(np.abs(omega).max()) < 0.005 and np.abs(tau).max() < 0.02


def test_prior_holds_back_what_the_images_do_not_show():
    splats, frames, renderer, draw = scene()
    images = draw(splats, frames)
    wrong = RigidMotions.exp(np.zeros((10, 3)), np.tile([0.5, 0, 0], (10, 1)))
    normals = accumulate(renderer, splats, wrong.correct(frames), images * 0 + images.mean(), None, 1.0)
    held, _, _ = step_full(normals, wrong, Prior(1e-9, 1e-9), LIMIT)
    omega, tau = held.vectors()
    assert np.abs(omega).max() < 1e-6
    assert np.abs(tau).max() < 0.5 * 1.1e-3  # back to nominal, but for the damping of one thousandth


def test_caution_yields_to_the_prior_only_where_the_images_say_little():
    splats, frames, renderer, draw = scene()
    images = draw(splats, frames)
    noise = np.random.default_rng(6).normal(0, 0.02 * images.max(), images.shape).astype(np.float32)
    ring = Splats(splats.means * np.float32([0, 0, 1]), np.full_like(splats.scales, 6.0), *splats.arrays()[2:])
    round_images = draw(ring, frames)  # blobs on the axis: turning about z shows nothing
    turned = RigidMotions.exp(np.tile([0.0, 0.0, 0.05], (10, 1)), np.tile([0.0, 0.0, 1.0], (10, 1)))
    tight = Prior(0.05, 5.0, strain=1e-9)
    normals = accumulate(renderer, ring, turned.correct(frames), round_images + noise, None, 1.0)
    step, _, _ = step_full(normals, turned, tight, LIMIT, caution=1000.0)
    omega, tau = step.vectors()
    assert np.abs(omega[:, 2]).max() < 0.01  # back towards nominal: the images do not hold it
    assert np.abs(tau[:, 2]).max() < 0.3  # the height is seen, and found


def test_caution_does_not_draw_back_a_view_that_was_found():
    splats, frames, renderer, draw = scene()
    images = draw(splats, frames)
    noise = np.random.default_rng(6).normal(0, 0.02 * images.max(), images.shape).astype(np.float32)
    turned = RigidMotions.exp(np.tile([0.0, 0.0, 0.3], (10, 1)), np.zeros((10, 3)))
    normals = accumulate(renderer, splats, frames, images + noise, None, 1.0)  # in place where turned
    there = turned.inverse().correct(frames)
    assert np.allclose(turned.correct(there).packed(), frames.packed())
    found = np.arange(10) < 5
    tight = Prior(0.05, 5.0, strain=1e-9)
    step, _, _ = step_full(normals, turned, tight, LIMIT, caution=3e4, found=found)
    moved = np.linalg.norm((step @ turned.inverse()).vectors()[0], axis=1)
    assert moved[found].max() < 0.1 * moved[~found].min()


def test_turns_that_an_image_hardly_shows_are_not_clear():
    splats, frames, renderer, draw = scene()
    ring = Splats(splats.means * np.float32([0, 0, 1]), np.full_like(splats.scales, 6.0), *splats.arrays()[2:])
    shifts = np.eye(6)[:, 3:]
    for what, turns in ((splats, 3), (ring, 1)):  # blobs on the axis: the turn about the ray alone
        for rigid in accumulate(renderer, what, frames, draw(what, frames), None, 1.0).rigid:
            basis = clear_directions(rigid)
            assert basis.shape == (6, turns + 3)
            assert np.allclose(basis.T @ basis, np.eye(turns + 3))
            assert np.allclose(basis @ basis.T @ shifts, shifts)
            if what is ring:
                assert np.abs(basis[2]).max() < 0.01  # about the axis
    assert clear_directions(np.zeros((6, 6))).shape == (6, 3)  # nothing in sight


def test_turns_that_an_image_hardly_shows_wait_and_all_else_moves():
    splats, frames, renderer, draw = scene()
    nearly_round = Splats(
        splats.means * np.float32([0.05, 0.05, 1]), np.full_like(splats.scales, 6.0), *splats.arrays()[2:]
    )
    turned = RigidMotions.exp(np.tile([0.004, 0.004, 0.004], (10, 1)), np.tile([0.5, 0.5, 0.5], (10, 1)))
    images = draw(nearly_round, turned.correct(frames))
    normals = accumulate(renderer, nearly_round, frames, images, None, 1.0)
    known = Prior(LOOSE.rotation, LOOSE.translation, strain=1e-9)
    for waiting in (False, True):
        step, _, _ = step_full(normals, RigidMotions.identity(10), known, LIMIT, waiting=waiting)
        omega, tau = step.vectors()
        assert np.abs(tau[:, 2] - 0.5).max() < 0.1
        about_axis = np.abs(omega[:, 2])
        assert about_axis.max() < 1e-4 if waiting else about_axis.max() > 1e-3, about_axis


def test_steps_are_limited():
    splats, frames, renderer, draw = scene()
    far = RigidMotions.exp(np.tile([0, 0, 0.3], (10, 1)), np.zeros((10, 3)))
    images = draw(splats, far.correct(frames))
    normals = accumulate(renderer, splats, frames, images, None, 1.0)
    step, _, _ = step_full(normals, RigidMotions.identity(10), LOOSE, np.array([0.01] * 3 + [0.1] * 3))
    omega, tau = step.vectors()
    assert np.abs(omega).max() <= 0.01 * (1 + 1e-9) and np.abs(tau).max() <= 0.1 * (1 + 1e-9)


def test_strain_of_the_object_is_found_together_with_the_poses():
    """A stretched object with right poses: the step must stretch the splats, not bend the poses."""
    splats, frames, renderer, draw = scene(views=16)
    stretch = np.diag([0.004, -0.003, 0.002]) + 0.002 * (np.eye(3)[[1, 0, 2]] - np.diag([0, 0, 1]))
    stretched = Splats((splats.means @ (np.eye(3) + stretch)).astype(np.float32), *splats.arrays()[1:])
    images = draw(stretched, frames)
    normals = accumulate(renderer, splats, frames, images, None, 1.0)
    step, strain, _ = step_full(normals, RigidMotions.identity(16), Prior(0.1, 10.0, strain=0.1), LIMIT)
    anisotropy = stretch - np.eye(3) * np.trace(stretch) / 3
    found = strain - np.eye(3) * np.trace(strain) / 3  # its mean is magnification, a gauge
    assert np.abs(found - anisotropy).max() < 0.1 * np.abs(anisotropy).max()
    omega, _ = step.vectors()
    assert np.rad2deg(np.abs(omega).max()) < 0.03


def test_explained_share_is_high_for_a_shifted_view_and_low_for_noise():
    splats, frames, renderer, draw = scene()
    images = draw(splats, frames)
    noise = np.random.default_rng(3).normal(0, 0.01 * images.max(), images.shape).astype(np.float32)
    shifted = RigidMotions.exp(np.zeros((10, 3)), np.tile([0.5, 0.5, 0.5], (10, 1))).correct(frames)
    moved = accumulate(renderer, splats, shifted, images, None, 1.0).explained()
    noisy = accumulate(renderer, splats, frames, images + noise, None, 1.0).explained()
    assert moved.min() > 0.9
    assert noisy.max() < 0.02  # six numbers on 4,096 pixels


def test_sigmas_are_the_scatter_of_repeated_fits():
    splats, frames, renderer, draw = scene(views=60)
    images = draw(splats, frames)
    level = 0.01 * float(images.max())
    noise = np.random.default_rng(4).normal(0, level, images.shape).astype(np.float32)
    found = RigidMotions.identity(60)
    tight = Prior(0.1, 10.0, strain=1e-9)
    for _ in range(3):
        normals = accumulate(renderer, splats, found.correct(frames), images + noise, None, 1.0)
        found, _, _ = step_full(normals, found, tight, LIMIT)
    omega, tau = found.vectors()
    sigma_omega, sigma_tau = sigmas(normals, tight)
    for error, sigma in ((omega, sigma_omega), (tau, sigma_tau)):
        inside = np.mean(np.abs(error) < sigma)
        assert 0.6 < inside < 0.76  # 68 % of 180 draws, two standard deviations
