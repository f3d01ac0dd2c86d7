"""Each operator against its twin: values and gradients, float32 and float64, on every instruction set."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import pytest
import torch
from torch import Tensor

from splatcore import ops, reference
from splatcore.geometry import Beam

from ..tolerances import gradient_error, name_of, tolerance, value_error
from . import scenes
from .scenes import COLS, MOTION, NO_MOTION, ROWS, SCENES, Cloud

NAMES = ["means", "scales", "quats", "density", "motion"]
GRID = torch.tensor([[6.0, 5.5, 7.0], [4.0, -3.0, 2.0]], dtype=torch.float64)  # voxel z y x, centre x y z, mm
SHAPE = (19, 23, 21)


def near_the_cutoff(squared: Tensor, visible: Tensor) -> Tensor:
    """Where some splat's dx'S^-1dx is within a thousandth of 16: rounding may put the pixel on either side, and a
    value of 3.4e-4 of the splat's peak appears or not. [n, ...] -> [...]"""
    close = (squared / reference.CUTOFF - 1).abs() < 1e-3
    return (close & visible.reshape(-1, *[1] * (squared.dim() - 1))).any(dim=0)


@dataclass(frozen=True)
class Twin:
    """What the twin says about one scene."""

    scene: str
    expected: Tensor  # the image or volume
    flips: Tensor  # pixels left out
    weights: Tensor  # of the functional whose gradient is compared
    gradients: tuple[Tensor, ...]

    @classmethod
    def of(cls, scene: str, expected: Tensor, flips: Tensor, leaves: list[Tensor]) -> Twin:
        assert flips.double().mean() < 0.02
        rng = torch.Generator().manual_seed(7)
        weights = torch.randn(*expected.shape, generator=rng, dtype=torch.float64).where(~flips, 0.0)
        return cls(scene, expected.detach(), flips, weights, torch.autograd.grad((expected * weights).sum(), leaves))

    def compare(self, actual: Tensor, leaves: list[Tensor]) -> None:
        error = value_error(actual.detach().where(~self.flips, 0), self.expected.where(~self.flips, 0))
        assert error < tolerance("value", actual.dtype, self.scene), f"{error:.2e}"
        got = torch.autograd.grad((actual * self.weights.to(actual.dtype)).sum(), leaves)
        for name, a, e in zip(NAMES[: len(got)], got, self.gradients, strict=True):
            assert torch.isfinite(a).all()
            if name != "motion":
                row = (len(e), -1)
                assert torch.equal((a.reshape(row) != 0).any(dim=1), (e.reshape(row) != 0).any(dim=1)), name
            error = gradient_error(a, e)
            assert error < tolerance(name, actual.dtype, self.scene), f"{name}: {error:.2e}"


@cache
def image_twin(dtype: torch.dtype, beam: Beam, scene: str, moved: bool) -> Twin:
    """dtype: what the splats are rounded to before the twin sees them."""
    cloud, view, cone = SCENES[scene](beam).to(dtype).to(torch.float64), scenes.frame(beam), beam == "cone"
    leaves = [*cloud.leaves(), (MOTION if moved else NO_MOTION).clone().requires_grad_()]
    with torch.no_grad():
        splats = reference.footprints(*leaves, view, cone, ROWS, COLS)
        flips = near_the_cutoff(splats.squared_distance(ROWS, COLS), splats.visible)
    return Twin.of(scene, reference.render(*leaves, view, cone, ROWS, COLS), flips, leaves)


@cache
def volume_twin(dtype: torch.dtype, scene: str) -> Twin:
    leaves = SCENES[scene]("cone").to(dtype).to(torch.float64).leaves()
    with torch.no_grad():
        flips = near_the_cutoff(reference.voxel_distance(*leaves[:3], GRID, SHAPE), torch.tensor(True))
    return Twin.of(scene, reference.voxelize(*leaves, GRID, SHAPE), flips, leaves)


@pytest.mark.parametrize("moved", [False, True], ids=["nominal", "moved"])
@pytest.mark.parametrize("scene", SCENES)
@pytest.mark.parametrize("beam", ["cone", "parallel"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=name_of)
def test_render(isa: str, dtype: torch.dtype, beam: Beam, scene: str, moved: bool) -> None:
    leaves = [*SCENES[scene](beam).to(dtype).leaves(), (MOTION if moved else NO_MOTION).clone().requires_grad_()]
    image = ops.render(*leaves, scenes.frame(beam), beam == "cone", ROWS, COLS)
    image_twin(dtype, beam, scene, moved).compare(image, leaves)


@pytest.mark.parametrize("scene", ["cloud", "needles", "edges"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=name_of)
def test_voxelize(isa: str, dtype: torch.dtype, scene: str) -> None:
    """Edges of the detector lie outside this grid or on its border."""
    leaves = SCENES[scene]("cone").to(dtype).leaves()
    volume_twin(dtype, scene).compare(ops.voxelize(*leaves, GRID, *SHAPE), leaves)


@pytest.mark.parametrize("what", ["cone", "parallel", "volume"])
def test_a_splat_that_shows_nowhere_is_nothing(isa: str, what: str) -> None:
    """Far away, in the source's plane, without mass, without size, or not a number: zero, and zero gradients."""
    c = scenes.cloud(8)
    means, scales, density = c.means.clone(), c.scales.clone(), c.density.clone()
    means[0] += 1e4
    means[1] = scenes.frame("cone")[0]
    density[2] = 0
    scales[3] = 0
    means[4, 1] = float("nan")
    density[5] = float("inf")
    scales[6, 2] = float("nan")
    means[7, 0] = float("inf")
    leaves = Cloud(means, scales, c.quats, density).leaves()
    if what == "volume":
        seen = ops.voxelize(*leaves, GRID, *SHAPE)
    else:
        leaves.append(NO_MOTION.clone().requires_grad_())
        # A parallel beam has no source whose plane could hold the second one.
        beam: Beam = "cone" if what == "cone" else "parallel"
        if beam == "parallel":
            leaves[:4] = [t.detach()[[0, 2, 3, 4, 5, 6, 7]].requires_grad_() for t in leaves[:4]]
        seen = ops.render(*leaves, scenes.frame(beam), beam == "cone", ROWS, COLS)
    assert torch.equal(seen, torch.zeros_like(seen))
    for gradient in torch.autograd.grad(seen.sum(), leaves):
        assert torch.equal(gradient, torch.zeros_like(gradient))


def test_arguments_are_checked_at_the_door() -> None:
    m, s, q, d = scenes.cloud().tensors()
    view = scenes.frame("cone")
    with pytest.raises(ValueError, match="quats must be torch"):
        ops.render(m, s, q[:, :3], d, NO_MOTION, view, True, ROWS, COLS)
    with pytest.raises(ValueError, match="density must be torch"):
        ops.render(m, s, q, d.float(), NO_MOTION, view, True, ROWS, COLS)
    with pytest.raises(TypeError, match="float32 or float64"):
        ops.render(m.half(), s.half(), q.half(), d.half(), NO_MOTION, view, True, ROWS, COLS)
    with pytest.raises(ValueError, match="frame must be float64"):
        ops.render(m, s, q, d, NO_MOTION, view.float(), True, ROWS, COLS)
    with pytest.raises(ValueError, match="grid must be float64"):
        ops.voxelize(m, s, q, d, GRID[0], *SHAPE)


def test_strided_inputs_are_taken_as_they_look() -> None:
    c, view = scenes.cloud(), scenes.frame("cone")
    strided = [t.repeat_interleave(2, dim=0)[::2] for t in c.tensors()]
    assert not strided[0].is_contiguous()
    assert torch.equal(
        ops.render(*strided, MOTION, view, True, ROWS, COLS), ops.render(*c.tensors(), MOTION, view, True, ROWS, COLS)
    )
