"""Every ray counts once: the weights of half fans, short scans and irregular views, and what FDK makes of them."""

from __future__ import annotations

import numpy as np
import pytest

from splatcore.geometry import Beam, Frames, circular
from splatcore.grid import VolumeGrid
from splatcore.redundancy import coverage, orbit, ray_weights
from splatcore.simulate import project
from splatcore.start import cut_off, fdk

from .phantom import phantom

COLS = 64
CUBE = VolumeGrid((40,) * 3, (5.0,) * 3)


def views(angles: np.ndarray, offset_u: float = 0.0, beam: Beam = "cone", cols: int = COLS) -> Frames:
    pixel = 6.0 if beam == "cone" else 4.3
    return circular(beam, angles, 500, 700, 48, cols, (pixel, pixel), (0.0, offset_u))


def even(count: int, arc: float = 360.0) -> np.ndarray:
    return np.arange(count) * arc / count


@pytest.mark.parametrize("beam", ["cone", "parallel"])
def test_a_full_circle_weighs_all_rays_alike(beam: Beam) -> None:
    """Half the angle to both neighbours, half again for the two ends of every ray."""
    np.testing.assert_allclose(ray_weights(views(even(90), beam=beam)), np.pi / 90, rtol=1e-9)
    gap = np.delete(even(90), [3, 40, 41])  # holes, not ends
    assert ray_weights(views(gap, beam=beam)).sum(axis=0) == pytest.approx(np.full(COLS, np.pi))
    again = np.concatenate([even(90), [28.0]])  # one angle taken twice
    weights = ray_weights(views(again, beam=beam))
    assert weights.sum(axis=0) == pytest.approx(np.full(COLS, np.pi))
    assert weights[7] == pytest.approx(0.5 * weights[3]) and weights[90] == pytest.approx(weights[7])


@pytest.mark.parametrize("beam", ["cone", "parallel"])
@pytest.mark.parametrize("offset", [0.0, 3.0, 60.0, 110.0, -110.0])
def test_both_copies_of_a_ray_weigh_one_in_a_half_fan(beam: Beam, offset: float) -> None:
    """Wang's condition w(s) + w(-s) = 1, s the signed distance from the axis; no jump where the second copy ends."""
    frames = views(even(120), offset, beam)
    weight = ray_weights(frames)[0] / (2 * np.pi / 120)
    place = (np.arange(COLS) - (COLS - 1) / 2) * np.linalg.norm(frames.u[0]) + offset * 1.0
    if beam == "cone":
        place = 500 * np.sin(np.arctan(place / 700))
    order = np.argsort(place)
    inside = np.abs(place) < 0.98 * min(place.max(), -place.min())
    opposite = np.interp(-place[inside], place[order], weight[order])
    assert weight[inside] + opposite == pytest.approx(np.ones(inside.sum()), abs=0.04)  # interpolated
    alone = np.abs(place) > min(place.max(), -place.min()) + np.abs(np.diff(place)).max()
    assert weight[alone] == pytest.approx(np.ones(alone.sum()), abs=1e-9)
    if abs(offset) > 50:
        assert np.abs(np.diff(weight)).max() < 0.3
    else:
        assert weight[COLS // 2] == pytest.approx(0.5, abs=0.06)


@pytest.mark.parametrize("arc", [180.0, 215.0, 240.0, 300.0])
@pytest.mark.parametrize("beam", ["cone", "parallel"])
def test_every_ray_of_a_short_scan_counts_once(beam: Beam, arc: float) -> None:
    """Weights summed over all samples of one ray's neighbourhood: pi in all for every distance from the axis."""
    frames = views(even(int(arc), arc), beam=beam)
    weights = ray_weights(frames)
    assert orbit(frames).arc == pytest.approx(np.deg2rad(arc))
    if beam == "parallel" or arc >= 215:  # a fan of 30.7 degrees needs 210.7
        both = weights.sum(axis=0) + weights.sum(axis=0)[::-1]
        assert both == pytest.approx(np.full(COLS, 2 * np.pi), rel=0.01)
    if arc >= 215:  # as much as is seen twice may be used to fade out
        assert np.abs(np.diff(weights, axis=0)).max() < 0.5 * np.deg2rad(1)


def test_several_turns_weigh_as_much_as_one() -> None:
    """Most neighbours then stand at the same angle, or as near as an encoder can tell."""
    angles = np.tile(even(24), 3) + np.repeat([0, 1e-5, 2e-5], 24)
    assert ray_weights(views(angles)).sum(axis=0) == pytest.approx(np.full(COLS, np.pi))


def test_coverage_is_one_where_all_views_see() -> None:
    x, y, _ = np.moveaxis(CUBE.centers_mm(), -1, 0)
    radius = np.hypot(x, y)
    for frames, reach in ((views(even(90)), 125.0), (views(even(180), 80.0, cols=40), 130.0)):
        assert coverage(frames, CUBE)[radius < 0.9 * min(reach, 100)] == pytest.approx(1, abs=0.08)
    narrow = coverage(views(even(90), cols=20), CUBE)  # sees 42 mm about the axis
    assert narrow[radius < 36] == pytest.approx(1, abs=0.05)
    assert narrow[radius > 60].max() < 0.75


@pytest.mark.parametrize(
    ("frames", "limit"),  # RMS of the phantom's values; in brackets with rays counted twice or with a jump
    [
        (views(even(90)), 0.044),  # observed 0.042
        (views(even(120), 60.0, cols=44), 0.055),  # 0.047 (0.071)
        (views(even(120), 90.0, cols=40), 0.085),  # 0.078 (0.099)
        (views(even(108, 215)), 0.050),  # 0.045 (0.059)
        (views(even(120, 270)), 0.050),  # 0.044 (0.064)
        (views(np.sort(np.random.default_rng(0).uniform(0, 360, 120))), 0.050),  # 0.042 (0.062)
        (views(even(60, 180), beam="parallel"), 0.045),  # 0.042
    ],
    ids=["circle", "half fan", "far half fan", "short", "270", "irregular", "parallel"],
)
def test_fdk_in_every_geometry(frames: Frames, limit: float) -> None:
    truth = phantom(40) * np.float32(0.01)
    images = project(truth, CUBE, frames, 1)
    x, y, _ = np.moveaxis(CUBE.centers_mm(), -1, 0)
    error = (fdk(images, frames, CUBE, 1) - truth)[np.hypot(x, y) < 95] / 0.01
    assert np.sqrt((error.astype(np.float64) ** 2).mean()) < limit
    assert not cut_off(images, frames)


def test_rows_cut_off_inside_the_object_leave_no_bright_rim() -> None:
    frames = views(even(90), cols=20)
    truth = phantom(40) * np.float32(0.01)
    images = project(truth, CUBE, frames, 1)
    assert cut_off(images, frames)
    x, y, z = np.moveaxis(CUBE.centers_mm(), -1, 0)
    error = (fdk(images, frames, CUBE, 1) - truth) / 0.01
    inside, rim = np.abs(z) < 40, np.hypot(x, y)
    assert abs(error[inside & (rim < 25)].mean()) < 0.03  # -0.017 (0.036 without)
    assert abs(error[inside & (rim > 32) & (rim < 40)].mean()) < 0.08  # -0.050 (0.153)
