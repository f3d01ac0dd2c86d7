"""Laws that hold whatever the code looks like: exact line integrals, mass, invariance, additivity, convergence."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from splatcore import _native, ops, reference
from splatcore.gauge import moved_frames
from splatcore.geometry import Beam, rotation_from_vector
from splatcore.splats import Similarity, Splats

from . import scenes
from .scenes import COLS, MOTION, NO_MOTION, ROWS, Cloud

BEAMS = pytest.mark.parametrize("beam", ["cone", "parallel"])


def image_of(cloud: Cloud, view: Tensor, beam: Beam, rows: int = ROWS, cols: int = COLS) -> Tensor:
    return ops.render(*cloud.tensors(), NO_MOTION, view, beam == "cone", rows, cols)


def on_the_ray(view: Tensor, beam: Beam, row: int, col: int, share: float) -> Tensor:
    """A point on a pixel's ray, `share` of the way from the source (parallel: 300 mm) to it. [3] mm"""
    first, center, u, v = view
    pixel = center + (col - (COLS - 1) / 2) * u + (row - (ROWS - 1) / 2) * v
    return first + share * (pixel - first) if beam == "cone" else pixel - 300 * (1 - share) * first


@BEAMS
def test_the_integral_through_the_centre_is_exact(isa: str, beam: Beam) -> None:
    """For any shape and orientation, at the middle of the detector and in its corners: eq. 5 has no affine error
    on the ray through the mean."""
    view = scenes.frame(beam)
    for k, (row, col) in enumerate([(18, 26), (0, 0), (36, 52), (5, 50)]):
        c = scenes.cloud(4, seed=k, sigma=25.0)
        for n in range(4):
            one = c[torch.tensor([n])]
            one = replace(one, means=on_the_ray(view, beam, row, col, 0.4 + 0.1 * n)[None])
            exact = reference.line_integrals(*one.tensors(), NO_MOTION, view, beam == "cone", ROWS, COLS)
            assert image_of(one, view, beam)[row, col].item() == pytest.approx(exact[0, row, col].item(), rel=1e-12)


def test_the_affine_error_vanishes_with_the_size() -> None:
    """Off the centre a cone-beam footprint is wrong by O(sigma / depth) of its peak; parallel ones are exact up to
    the cut-off at exp(-8)."""
    worst = []
    for sigma in (8.0, 4.0, 2.0):
        # The detector shrinks along, so that the footprint always has the same number of pixels.
        view = scenes.frame("cone")
        view[2:] *= sigma / 8
        c = replace(scenes.cloud(1, seed=8, sigma=sigma), means=on_the_ray(view, "cone", 20, 27, 0.65)[None])
        exact = reference.line_integrals(*c.tensors(), NO_MOTION, view, True, ROWS, COLS)[0]
        shown = image_of(c, view, "cone") > 0
        worst.append(((image_of(c, view, "cone") - exact)[shown].abs().max() / exact.max()).item())
    assert worst[0] < 0.01  # observed 2.3e-3, 1.1e-3, 5.6e-4
    assert 1.8 < worst[0] / worst[1] < 2.2
    assert 1.8 < worst[1] / worst[2] < 2.2
    c, view = scenes.cloud(), scenes.frame("parallel")
    exact = reference.line_integrals(*c.tensors(), NO_MOTION, view, False, ROWS, COLS)
    peaks = exact.amax(dim=(1, 2)).sum()
    assert (exact.sum(dim=0) - image_of(c, view, "parallel")).abs().max() < np.exp(-8) * peaks


def test_mass_is_conserved_in_parallel_beams(isa: str) -> None:
    """The image's integral over the detector is the volume's: rho (2 pi)^(3/2) s0 s1 s2 but for the cut-off's
    exp(-8). The sum over pixels is exact for smooth functions; the cut's edge leaves 1e-4."""
    c, view = scenes.cloud(20, spread=30.0), scenes.frame("parallel")
    pixel = torch.linalg.cross(view[2], view[3]) @ view[0]  # mm^2 across the rays
    mass = (c.density * c.scales.prod(dim=1) * (2 * torch.pi) ** 1.5).sum()
    image = image_of(c, view, "parallel", 90, 90)
    assert (image.sum() * pixel.abs() / mass).item() == pytest.approx(1 - np.exp(-8), abs=1e-4)


def test_mass_is_conserved_in_cone_beams(isa: str) -> None:
    """A point source spreads a small Gaussian at depth z over the cone: dV = z^2 / |p - s|^3 (p - s).n dA dl."""
    view = scenes.frame("cone")
    first, center, u, v = view
    row, col = torch.arange(ROWS) - (ROWS - 1) / 2, torch.arange(COLS) - (COLS - 1) / 2
    away = center - first + col[None, :, None] * u + row[:, None, None] * v  # [r, c, 3]
    area = torch.linalg.cross(u, v)
    for n in range(5):
        c = scenes.cloud(1, seed=n, sigma=6.0, spread=40.0)
        share = (c.means[0] - first) @ area / ((center - first) @ area)
        # The length from the source to the Gaussian is share |p - s|.
        weight = share**2 * (away @ area).abs() / away.norm(dim=-1)
        mass = c.density[0] * c.scales.prod() * (2 * torch.pi) ** 1.5
        image = image_of(c, view, "cone")
        assert ((image * weight).sum() / mass).item() == pytest.approx(1, abs=3e-3)


@BEAMS
def test_moving_world_and_views_together_changes_nothing(isa: str, beam: Beam) -> None:
    """The gauge: a rigid motion of everything, and for cone beams magnification (density falls as 1 / scale)."""
    rng = np.random.default_rng(5)
    views = scenes.frames(beam)
    splats = Splats(*(a.astype(np.float32) for a in scenes.cloud().numpy()))
    similarity = Similarity(
        rotation_from_vector(rng.normal(0, 1, 3)), rng.normal(0, 30, 3), 1.3 if beam == "cone" else 1.0
    )
    moved, there = splats.moved(similarity), moved_frames(views, similarity)
    renderer = _native.Renderer32(ROWS, COLS, 2)
    before, after = np.empty((ROWS, COLS), np.float32), np.empty((ROWS, COLS), np.float32)
    for here, other in zip(views.packed(), there.packed(), strict=True):
        renderer.render(here, beam == "cone", *splats.arrays(), before)
        renderer.render(other, beam == "cone", *moved.arrays(), after)
        # One pixel in float32 may fall on the other side of the cut-off.
        jump = np.sort(np.abs(after - before).ravel())
        assert jump[-5] < 1e-5 * before.max()
        assert jump[-1] < 1e-3 * before.max()


@BEAMS
def test_images_add_up_and_order_does_not_matter(isa: str, beam: Beam) -> None:
    c, view = scenes.cloud(300), scenes.frame(beam)
    order = torch.randperm(300, generator=torch.Generator().manual_seed(0))
    whole = image_of(c, view, beam)
    parts = image_of(c[order[:120]], view, beam) + image_of(c[order[120:]], view, beam)
    assert torch.allclose(parts, whole, rtol=1e-13, atol=1e-14)
    assert torch.allclose(image_of(c[order], view, beam), whole, rtol=1e-13, atol=1e-14)


@BEAMS
def test_gradients_add_up_and_follow_their_splats(isa: str, beam: Beam) -> None:
    c, view = scenes.cloud(300), scenes.frame(beam)
    y = torch.randn(ROWS, COLS, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    order = torch.randperm(300, generator=torch.Generator().manual_seed(0))
    whole = ops.render_vjp(y, *c.tensors(), MOTION, view, beam == "cone")
    parts = [ops.render_vjp(y, *c[k].tensors(), MOTION, view, beam == "cone") for k in (order[:120], order[120:])]
    for k in range(4):
        mixed = torch.cat([part[k] for part in parts])
        assert torch.allclose(mixed, whole[k][order], rtol=1e-11, atol=1e-14)
    assert torch.allclose(parts[0][4] + parts[1][4], whole[4], rtol=1e-11)


@BEAMS
def test_joseph_converges_to_the_line_integral(isa: str, beam: Beam) -> None:
    """A smooth Gaussian on a grid, along oblique rays: the error of linear interpolation falls as the voxel squared."""
    view = scenes.frame(beam)
    c = scenes.cloud(1, seed=6, sigma=20.0, spread=10.0)
    exact = reference.line_integrals(*c.tensors(), NO_MOTION, view, beam == "cone", ROWS, COLS)[0]
    errors = []
    for n in (24, 48, 96):
        grid = torch.tensor([[240.0 / n] * 3, [2.0, 3.0, -1.0]], dtype=torch.float64)
        z, y, x = (grid[1][2 - i] + (torch.arange(n).double() - (n - 1) / 2) * grid[0, 0] for i in range(3))
        zz, yy, xx = torch.meshgrid(z, y, x, indexing="ij")
        away = torch.stack([xx, yy, zz], dim=-1) - c.means[0]
        own = (away @ reference.rotations(c.quats)[0]) / c.scales[0]
        volume = c.density[0] * torch.exp(-own.square().sum(dim=-1) / 2)
        image = torch.empty(ROWS, COLS, dtype=torch.float64)
        _native.project_volume(view, beam == "cone", grid, volume, image, 2)
        errors.append(((image - exact).abs().max() / exact.max()).item())
    assert errors[2] < 5e-3
    assert 3 < errors[1] / errors[2] < 5, errors
