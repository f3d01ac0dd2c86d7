"""Splats shaped after the object: their axes against the normals and directions of shapes known in closed form."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from splatcore.geometry import Array
from splatcore.grid import VolumeGrid
from splatcore.reference import rotations
from splatcore.splats import Floats, Splats
from splatcore.structure import aligned

GRID = VolumeGrid((30, 40, 36), (1.5, 1.0, 1.2), (3.0, -2.0, 1.0))  # no two sides alike
SIGMA = 1.8


def round_splats(points: Array) -> Splats:
    n = len(points)
    quats = np.tile(np.array([1, 0, 0, 0], np.float32), (n, 1))
    density = np.linspace(0.01, 0.02, n, dtype=np.float32)
    return Splats(points.astype(np.float32), np.full((n, 3), SIGMA, np.float32), quats, density)


def soft(distance: Array) -> Floats:
    """Dense (0.02 per mm) where the distance is negative, with an edge as soft as a reconstruction's."""
    return np.asarray(0.02 / (1 + np.exp(np.clip(2 * distance, -50, 50))), np.float32)


def axes_of(splats: Splats) -> Array:
    """Unit vectors along each splat's own axes, its columns. [n, 3, 3]"""
    return np.asarray(rotations(torch.from_numpy(splats.quats.astype(np.float64))).numpy())


def own_axis(splats: Splats, chosen: Array) -> Array:
    """The unit vector along each splat's axis number chosen [n]. [n, 3]"""
    return np.take_along_axis(axes_of(splats), chosen[:, None, None], axis=2)[:, :, 0]


def test_flat_across_a_face_whatever_way_it_lies() -> None:
    middle, radius = np.array(GRID.center_mm), 11.0
    volume = soft(np.linalg.norm(GRID.centers_mm() - middle, axis=-1) - radius)
    out = np.random.default_rng(0).normal(size=(200, 3))
    out /= np.linalg.norm(out, axis=1, keepdims=True)
    shaped = aligned(round_splats(middle + radius * out), volume, GRID)
    shortest = shaped.scales.argmin(axis=1)
    assert np.abs(np.sum(own_axis(shaped, shortest) * out, axis=1)).min() > np.cos(np.deg2rad(12))
    ordered = np.sort(shaped.scales, axis=1)
    assert (ordered[:, 0] < 0.6 * SIGMA).all() and (ordered[:, 1:] > 1.5 * SIGMA).all()


def test_long_along_a_wire() -> None:
    along = np.array([1.0, 2.0, -1.0]) / np.sqrt(6)
    middle = np.array(GRID.center_mm)
    away = GRID.centers_mm() - middle
    volume = soft(np.linalg.norm(away - (away @ along)[..., None] * along, axis=-1) - 1.5)
    shaped = aligned(round_splats(middle + np.linspace(-8, 8, 20)[:, None] * along), volume, GRID)
    longest = shaped.scales.argmax(axis=1)
    assert np.abs(own_axis(shaped, longest) @ along).min() > np.cos(np.deg2rad(10))
    others = np.sort(shaped.scales, axis=1)[:, :2]
    assert (shaped.scales.max(axis=1) > 1.8 * SIGMA).all() and np.abs(others / SIGMA - 1).max() < 0.35


def test_round_where_there_is_no_face() -> None:
    middle = np.array(GRID.center_mm)
    volume = soft(np.linalg.norm(GRID.centers_mm() - middle, axis=-1) - 14.0)
    inside = middle + np.random.default_rng(1).uniform(-3, 3, (50, 3))
    np.testing.assert_allclose(aligned(round_splats(inside), volume, GRID).scales, SIGMA, rtol=0.02)


def test_each_splat_keeps_its_integral_and_its_place() -> None:
    rng = np.random.default_rng(2)
    volume = rng.uniform(0, 0.02, GRID.shape).astype(np.float32)
    before = round_splats(np.array(GRID.center_mm) + rng.uniform(-12, 12, (300, 3)))
    after = aligned(before, volume, GRID)
    integral = [splats.density * splats.scales.prod(axis=1) for splats in (before, after)]
    np.testing.assert_allclose(integral[1], integral[0], rtol=1e-5)
    np.testing.assert_array_equal(after.means, before.means)
    axes = axes_of(after)
    np.testing.assert_allclose(axes @ axes.transpose(0, 2, 1), np.broadcast_to(np.eye(3), axes.shape), atol=1e-5)
    assert all(a.dtype == np.float32 and a.flags.c_contiguous for a in after.arrays())


@pytest.mark.parametrize("case", ["one slice", "nothing there"])
def test_left_alone_where_there_is_nothing_to_go_by(case: str) -> None:
    grid = VolumeGrid((1, 40, 36), (1.5, 1.0, 1.2)) if case == "one slice" else GRID
    volume = np.zeros(grid.shape, np.float32)
    volume[:, 10:20] = 0.02 * (case == "one slice")
    before = round_splats(np.random.default_rng(3).uniform(-9, 9, (30, 3)))
    assert aligned(before, volume, grid) is before


def test_a_world_stretched_with_its_voxels_gives_stretched_splats() -> None:
    """Splats round in long voxels are shaped as those round in cubes, then stretched; none of them is turned first."""
    cubes = VolumeGrid((30, 36, 32), (1.0, 1.0, 1.0))
    long = VolumeGrid(cubes.shape, (4.0, 1.0, 2.0))
    stretched = np.array([2.0, 1.0, 4.0])  # x y z
    volume = soft(np.linalg.norm(cubes.centers_mm() - 1.5, axis=-1) - 10.0)
    out = np.random.default_rng(4).normal(size=(100, 3))
    before = round_splats(1.5 + 10 * out / np.linalg.norm(out, axis=1, keepdims=True))
    means, scales = (np.asarray(a * stretched, np.float32) for a in (before.means, before.scales))
    one, other = aligned(before, volume, cubes), aligned(replace(before, means=means, scales=scales), volume, long)

    def covariance(splats: Splats) -> Array:
        half = axes_of(splats) * splats.scales[:, None, :]
        return np.asarray(half @ half.transpose(0, 2, 1))

    expected = stretched[:, None] * covariance(one) * stretched
    np.testing.assert_allclose(covariance(other), expected, rtol=1e-3, atol=1e-3 * SIGMA**2)
    np.testing.assert_allclose(other.density, one.density, rtol=1e-4)
