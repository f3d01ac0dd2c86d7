"""SART and CGLS against dense matrices on problems small enough to write down."""

from __future__ import annotations

import numpy as np
import pytest

from splatcore.classical import backproject, cgls, sart, spread
from splatcore.geometry import Beam, Frames, RigidMotions, circular
from splatcore.grid import VolumeGrid
from splatcore.simulate import project

GRID = VolumeGrid((4, 5, 6), (9.0, 8.0, 7.0), (1.0, -2.0, 0.5))


def frames(beam: Beam, views: int = 9) -> Frames:
    """Knocked askew, more rays than voxels."""
    plain = circular(
        beam, np.arange(views) * 360 / views + 7, 300, 450, 7, 8, (9.0, 9.0) if beam == "cone" else (6.0, 7.0)
    )
    rng = np.random.default_rng(3)
    return RigidMotions.exp(rng.normal(0, 0.1, (views, 3)), rng.normal(0, 2, (views, 3))).correct(plain)


def matrix(views: Frames) -> np.ndarray:
    """A [rays, voxels], a column for each voxel."""
    columns = []
    for k in range(GRID.voxels):
        one = np.zeros(GRID.voxels, np.float32)
        one[k] = 1
        columns.append(project(one.reshape(GRID.shape), GRID, views, 1).ravel())
    return np.array(columns, np.float64).T


def volume(seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(0.001, 0.02, GRID.shape).astype(np.float32)


@pytest.mark.parametrize("beam", ["cone", "parallel"])
def test_backproject_is_the_transpose(beam: Beam) -> None:
    views = frames(beam)
    images = np.random.default_rng(1).normal(0, 1, (9, 7, 8)).astype(np.float32)
    expected = (matrix(views).T @ images.ravel()).reshape(GRID.shape)
    np.testing.assert_allclose(backproject(images, views, GRID, 1), expected, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("beam", ["cone", "parallel"])
def test_cgls_is_least_squares(beam: Beam) -> None:
    """Of noisy data, which no volume explains."""
    views = frames(beam)
    dense = matrix(views)
    data = project(volume(), GRID, views, 1)
    data += np.random.default_rng(2).normal(0, 0.02 * data.max(), data.shape).astype(np.float32)
    expected, _, rank, _ = np.linalg.lstsq(dense, data.ravel(), rcond=None)
    assert rank == GRID.voxels
    found = cgls(data, views, GRID, 1, iterations=400)
    np.testing.assert_allclose(found.ravel(), expected, atol=2e-3 * np.abs(expected).max())


def test_cgls_steps_are_those_of_the_krylov_space() -> None:
    """After k steps: the least squares solution among combinations of A'b, (A'A) A'b, ..."""
    views = frames("cone")
    dense, data = matrix(views), project(volume(), GRID, views, 1)
    right = dense.T @ data.ravel()
    basis = [right / np.linalg.norm(right)]
    for _ in range(3):
        following = dense.T @ (dense @ basis[-1])
        for known in basis:  # orthogonal, or powers of one matrix are too much alike
            following -= (known @ following) * known
        basis.append(following / np.linalg.norm(following))
    space = np.array(basis).T
    expected = space @ np.linalg.lstsq(dense @ space, data.ravel(), rcond=None)[0]
    found = cgls(data, views, GRID, 1, iterations=4)
    np.testing.assert_allclose(found.ravel(), expected, atol=1e-4 * np.abs(expected).max())


@pytest.mark.parametrize("subset", [1, 3, 9])
def test_sart_iteration(subset: int) -> None:
    """Two iterations by dense matrices, in the order of the subsets."""
    views = frames("cone")
    dense, data = matrix(views).reshape(9, 56, -1), project(volume(), GRID, views, 1)
    x = volume(5).ravel().astype(np.float64)
    for _ in range(2):
        for chosen in spread(9, subset):
            part = dense[chosen].reshape(-1, GRID.voxels)
            rays, cover = part.sum(axis=1), part.sum(axis=0)
            safe_r = np.where(rays > 1e-3 * rays.max(), 1 / np.maximum(rays, 1e-9), 0)
            safe_c = np.where(cover > 1e-3 * cover.max(), 1 / np.maximum(cover, 1e-9), 0)
            x += 0.7 * safe_c * (part.T @ (safe_r * (data[chosen].ravel() - part @ x)))
            x = np.maximum(x, 0)
    start = volume(5)
    found = sart(data, views, GRID, 1, iterations=2, subset=subset, relaxation=0.7, start=start)
    np.testing.assert_allclose(found.ravel(), x, atol=2e-5 * np.abs(x).max())
    assert np.array_equal(start, volume(5))


def test_sart_finds_the_volume_of_consistent_data() -> None:
    views, true = frames("cone", 15), volume()
    data = project(true, GRID, views, 1)
    found = sart(data, views, GRID, 1, iterations=300, subset=1, relaxation=1.0)
    assert np.abs(found - true).max() < 0.03 * true.max()
    assert np.abs(project(found, GRID, views, 1) - data).max() < 0.002 * data.max()


def test_positivity_is_kept_or_not_as_asked() -> None:
    views = frames("cone")
    data = project(volume() - np.float32(0.011), GRID, views, 1)
    assert sart(data, views, GRID, 1, iterations=5, positivity=True).min() == 0
    assert sart(data, views, GRID, 1, iterations=5, positivity=False).min() < 0


@pytest.mark.parametrize(("views", "subset"), [(75, 1), (75, 10), (7, 100), (1, 1)])
def test_subsets_hold_every_view_once(views: int, subset: int) -> None:
    subsets = spread(views, subset)
    assert sorted(np.concatenate(subsets).tolist()) == list(range(views))
