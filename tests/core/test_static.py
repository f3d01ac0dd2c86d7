"""The scanner's constant errors: the group they form, their derivative, what shows of them, and finding them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from splatcore import _native
from splatcore.geometry import Frames, RigidMotions, circular
from splatcore.observability import sensitivity
from splatcore.poses import Prior, accumulate, sigmas, step_full
from splatcore.simulate import Simulation, true_frames
from splatcore.splats import Splats
from splatcore.static import (
    Static,
    accumulate_static,
    axis_column,
    observable,
    sigmas_of_mean,
    split_static,
    step_static,
    tangents,
    without_doubtful_yaw,
)

ALL_AT_ONCE = Static(2.0, 0.8, -0.6, 0.9)
LOOSE = Prior(rotation=0.1, translation=10.0)
LIMIT = np.array([0.1] * 3 + [20.0] * 3)
KNOWN = replace(LOOSE, strain=1e-9)  # the object is known: it may not stretch


def orbit(beam="cone", views: int = 12, rows: int = 64, cols: int = 64, offset=(0.0, 0.0)) -> Frames:
    return circular(beam, np.arange(views) * 360 / views, 500, 700, rows, cols, (4.0, 4.0), offset)


def jitter(views: int, seed: int = 5) -> RigidMotions:
    rng = np.random.default_rng(seed)
    return RigidMotions.exp(rng.normal(0, 0.02, (views, 3)), rng.normal(0, 1.0, (views, 3)))


def same_frames(one: Frames, two: Frames, within: float) -> bool:
    return all(np.abs(a - b).max() < within for a, b in zip(one.packed(), two.packed(), strict=True))


def blobs(seed: int = 0) -> Splats:
    rng = np.random.default_rng(seed)
    return Splats(
        rng.uniform(-45, 45, (40, 3)).astype(np.float32),
        rng.uniform(4, 9, (40, 3)).astype(np.float32),
        rng.normal(size=(40, 4)).astype(np.float32),
        rng.uniform(0.002, 0.01, 40).astype(np.float32),
    )


def draw(splats: Splats, frames: Frames, double: bool = False) -> np.ndarray:
    kind = np.float64 if double else np.float32
    renderer = (_native.Renderer64 if double else _native.Renderer32)(frames.rows, frames.cols, 1)
    images = np.empty((len(frames), frames.rows, frames.cols), kind)
    arrays = [np.ascontiguousarray(array, kind) for array in splats.arrays()]
    for image, frame in zip(images, frames.packed(), strict=True):
        renderer.render(frame, frames.beam == "cone", *arrays, image)
    return images


# Laws.


@pytest.mark.parametrize("beam", ["cone", "parallel"])
def test_no_errors_change_nothing(beam):
    frames = orbit(beam, offset=(7.0, -30.0))
    assert same_frames(Static().apply(frames), frames, 1e-11)


@pytest.mark.parametrize(
    "what",
    [
        {"offset_px": (2.0, 0.0)},
        {"roll_deg": 0.8},
        {"axis_pitch_deg": -0.6},
        {"yaw_deg": 0.9},
        {"offset_px": (2.0, 0.0), "roll_deg": 0.8, "axis_pitch_deg": -0.6, "yaw_deg": 0.9},
    ],
)
def test_errors_mean_what_simulated_scans_mean_by_them(what):
    """Each number to second order: a detector 8 mm off its place swings 0.05 mm nearer to the source."""
    frames = orbit()
    true = true_frames(frames, Simulation(views=12, **what), 1.0, np.random.default_rng(0))
    numbers = {**what, "offset_px": what.get("offset_px", (0.0, 0.0))[0]}
    points = np.random.default_rng(1).uniform(-60, 60, (40, 3))
    assert np.abs(Static(**numbers).apply(frames).project(points) - true.project(points)).max() < 0.003


@pytest.mark.parametrize("beam", ["cone", "parallel"])
def test_the_axis_falls_where_it_is_said_to(beam):
    assert axis_column(Static(offset_px=2.0).apply(orbit(beam))) == pytest.approx(31.5 - 2.0, abs=1e-3)
    assert Static(offset_px=2.0).to_json(orbit(beam))["cor_px"] == pytest.approx(29.5, abs=1e-3)


def test_binned_errors_are_those_of_binned_frames():
    frames = orbit()
    fine, coarse = ALL_AT_ONCE.apply(frames).binned(4), ALL_AT_ONCE.binned(4).apply(frames.binned(4))
    assert same_frames(fine, coarse, 1e-9)


@pytest.mark.parametrize("beam", ["cone", "parallel"])
def test_the_static_part_takes_all_that_views_share_and_no_frame_moves(beam):
    frames = orbit(beam, offset=(0.0, -20.0))
    given = Static(1.0, 0.3, -0.2, 0.1 if beam == "cone" else 0.0)
    motions = jitter(12)
    static, rest = split_static(frames, given, motions)
    before, after = motions.correct(given.apply(frames)), rest.correct(static.apply(frames))
    assert same_frames(before, after, 1e-9)
    omega, tau = (np.einsum("vij,vj->vi", frames.axes(), part).mean(axis=0) for part in rest.vectors())
    assert max(abs(omega[0]), abs(omega[2]), abs(tau[0])) < 1e-12
    shared = [np.einsum("vij,vj->vi", frames.axes(), part).mean(axis=0) for part in motions.vectors()]
    assert min(abs(shared[0][0]), abs(shared[0][2]), abs(shared[1][0])) > 1e-4  # or the test shows nothing


# What shows.


def test_what_an_object_that_is_free_leaves_of_each_error():
    """design.md section 2: roll 0.92, pitch 0.63, yaw 0.092 px a degree; v offset 0.08 px a px; DSD 0.006 px a mm."""
    frames = circular("cone", np.arange(75) * 4.8, 500, 700, 256, 256, (1.5625, 1.5625))
    left = sensitivity(frames, 58.0)
    expected = {"cor_px": 1.0, "roll_deg": 0.92, "axis_pitch_deg": 0.63, "yaw_deg": 0.092, "v_offset_px": 0.08}
    for name, value in expected.items():
        assert left[name] == pytest.approx(value, rel=0.06), name
    assert left["dsd_mm"] == pytest.approx(0.006, rel=0.2)
    for name in ("detector_tilt_deg", "dso_mm", "z_shift_mm"):
        assert left[name] < 1e-6, name


@pytest.mark.parametrize(("beam", "rows", "cols"), [("cone", 64, 64), ("parallel", 64, 64), ("cone", 1, 64),
                                                    ("parallel", 1, 64), ("cone", 64, 1)])  # fmt: skip
def test_only_what_shows_is_solved(beam, rows, cols):
    frames = orbit(beam, 24, rows, cols)
    left = sensitivity(frames, 50.0)
    shown = np.array([left[name] for name in ("cor_px", "roll_deg", "axis_pitch_deg", "yaw_deg")])
    assert (shown[observable(frames)] > 0.02).all()
    if cols > 1:
        assert observable(frames)[0]


def test_what_does_not_show_stays_nominal():
    splats, frames = blobs(), orbit("parallel")
    images = draw(splats, Static(1.0, 0.5, 0.5).apply(frames))
    renderer = _native.Renderer32(64, 64, 1)
    still, static = RigidMotions.identity(12), Static()
    for _ in range(5):
        normals = accumulate_static(renderer, splats, frames, static, still, images, None, 1.0)
        static, _, sigma = step_static(normals, frames, static, still, KNOWN)
    assert static.vector() == pytest.approx([1.0, 0.5, 0.5, 0.0], abs=2e-3)
    assert static.yaw_deg == 0.0 and np.isinf(sigma[3]) and np.isfinite(sigma[:3]).all()


# The derivative.


@pytest.mark.parametrize("beam", ["cone", "parallel"])
def test_the_gradient_is_that_of_finite_differences(beam):
    """d(sum r^2 / 2) along each number: normal equations and tangents against float64 images a small step apart."""
    splats, frames, static, motions = blobs(), orbit(beam), replace(ALL_AT_ONCE, yaw_deg=0.9), jitter(12)
    if beam == "parallel":
        static = replace(static, yaw_deg=0.0)
    target = draw(splats, frames, double=True)
    renderer = _native.Renderer32(64, 64, 1)
    huge = 1e3
    normals = accumulate_static(renderer, splats, frames, static, motions, target.astype(np.float32), None, huge)
    into = tangents(frames, static, motions)
    found = np.einsum("vij,vi->j", into, normals.gradient[:, [0, 1, 2, 3, 4, 5, 12]])

    def loss(vector: np.ndarray) -> float:
        images = draw(splats, motions.correct(Static.of(vector).apply(frames)), double=True)
        return 0.5 * float(((images - target) ** 2).sum())

    for k in range(4 if beam == "cone" else 3):
        step = 0.05 * np.eye(4)[k]  # long enough for pixels that enter and leave footprints to average out
        difference = (loss(static.vector() + step) - loss(static.vector() - step)) / 0.1
        assert found[k] == pytest.approx(difference, rel=5e-3, abs=1e-3), k


def test_the_yaw_row_is_weighted_like_the_others():
    """With the yaw's image put in place of a rotation's the products must be the same: pan about the source is
    detector shift and keystone, so compare a mask and robust weights through the products of the residual itself."""
    splats, frames = blobs(), orbit(views=4)
    images = draw(splats, Static(1.5, 0.4).apply(frames))
    mask = np.ones((64, 64), np.float32)
    mask[:, :30] = 0.0
    renderer, still = _native.Renderer32(64, 64, 1), RigidMotions.identity(4)
    huber = 0.01
    normals = accumulate_static(renderer, splats, frames, Static(), still, images, mask, huber)
    plain = accumulate(renderer, splats, frames, images, mask, huber)
    assert np.array_equal(normals.hessian[:, :12, :12], plain.hessian)
    drawn = draw(splats, frames, double=True)
    step = 1e-3
    yaw = draw(splats, Static(yaw_deg=step).apply(frames), double=True)
    yaw = (yaw - draw(splats, Static(yaw_deg=-step).apply(frames), double=True)) / (2 * np.deg2rad(step))
    shift = np.zeros((4, 3))
    shift[:, 2] = step
    moved = draw(splats, RigidMotions.exp(np.zeros((4, 3)), shift).correct(frames), double=True)
    moved = (moved - draw(splats, RigidMotions.exp(np.zeros((4, 3)), -shift).correct(frames), double=True)) / (2 * step)
    residual = drawn - images
    weight = mask * np.minimum(1.0, huber / np.maximum(np.abs(residual), 1e-30))
    assert (weight[:, :, 30:] < 1).mean() > 0.01  # or the test shows nothing
    for found, expected in (
        (normals.gradient[:, 12], (weight * yaw * residual).sum(axis=(1, 2))),
        (normals.hessian[:, 12, 12], (weight * yaw * yaw).sum(axis=(1, 2))),
        (normals.hessian[:, 12, 5], (weight * yaw * moved).sum(axis=(1, 2))),
    ):
        assert np.abs(found - expected).max() < 0.01 * np.abs(expected).max()


# Finding them.


def test_a_known_object_gives_all_four_with_the_scatter_that_is_said():
    splats, frames = blobs(), orbit()
    images = draw(splats, ALL_AT_ONCE.apply(frames))
    level = 0.01 * float(images.max())
    errors, said = [], np.zeros(4)
    renderer, still = _native.Renderer32(64, 64, 1), RigidMotions.identity(12)
    for seed in range(12):
        noisy = images + np.random.default_rng(seed).normal(0, level, images.shape).astype(np.float32)
        static = ALL_AT_ONCE if seed else Static()
        for _ in range(2 if seed else 6):
            normals = accumulate_static(renderer, splats, frames, static, still, noisy, None, 1.0)
            static, _, said = step_static(normals, frames, static, still, KNOWN)
        errors.append(static.vector() - ALL_AT_ONCE.vector())
    ratio = np.sqrt((np.array(errors) ** 2).mean(axis=0)) / said
    assert (ratio > 0.4).all() and (ratio < 1.7).all()  # chi of 12 draws: 0.5 to 1.5 in 99 of 100


def test_free_views_and_the_scanner_together_find_both():
    """Jitter and all four errors at once, the object known: the arrow-shaped step with the yaw shared."""
    splats, frames, motions = blobs(), orbit(views=16), jitter(16)
    true = motions.correct(ALL_AT_ONCE.apply(frames))
    images = draw(splats, true)
    renderer = _native.Renderer32(64, 64, 1)
    static, found = Static(), RigidMotions.identity(16)
    loose = Prior(rotation=1.0, translation=100.0, strain=1e-9)
    for _ in range(10):
        normals = accumulate_static(renderer, splats, frames, static, found, images, None, 1.0)
        found, _, yaw = step_full(normals, found, loose, LIMIT, yaw=np.deg2rad(static.yaw_deg))
        static = replace(static, yaw_deg=static.yaw_deg + float(np.rad2deg(yaw)))
        static, found = split_static(frames, static, found)
    points = np.random.default_rng(1).uniform(-45, 45, (40, 3))
    assert np.abs(found.correct(static.apply(frames)).project(points) - true.project(points)).max() < 0.02
    shared, _ = split_static(frames, ALL_AT_ONCE, motions)
    assert static.vector() == pytest.approx(shared.vector(), abs=0.02)
    deviation = sigmas_of_mean(normals, frames, loose)
    rotation, _ = sigmas(normals, loose)
    assert (deviation > 0).all() and np.isfinite(deviation).all()
    assert deviation[1] < np.rad2deg(rotation.max()) / 3  # a mean of sixteen


def test_a_doubtful_yaw_is_dropped_and_a_clear_one_kept():
    frames, still = orbit(), RigidMotions.identity(12)
    assert without_doubtful_yaw(frames, Static(2.0, yaw_deg=0.1), still, 0.001) == (Static(2.0), False)
    assert without_doubtful_yaw(frames, Static(2.0, yaw_deg=0.8), still, 0.2) == (Static(2.0), False)
    clear = Static(2.0, yaw_deg=-0.8)
    assert without_doubtful_yaw(frames, clear, still, 0.01) == (clear, True)


def test_where_views_scatter_their_mean_does_not_turn_the_detector():
    """A shift of 0.1 px is well within the mean of jitter of a millimetre: the detector moved with the source."""
    frames = orbit()
    found, clear = without_doubtful_yaw(frames, Static(0.1, yaw_deg=0.1), jitter(12), 0.001)
    assert not clear and found.offset_px == 0.1 and found.yaw_deg != 0
    assert found.turned(frames) == pytest.approx(0, abs=1e-12)
