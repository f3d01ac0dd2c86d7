"""R2-Gaussian's rules as laws, and both loops on a small scan."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from splatcore import _native, ops, r2
from splatcore.densify import Rules, ScreenGradient, densify
from splatcore.descent import Descent, Rates
from splatcore.errors import OptionsError, ReconstructionError
from splatcore.gauge import align, pose_errors
from splatcore.geometry import Beam, Frames
from splatcore.grid import VolumeGrid
from splatcore.options import Options
from splatcore.r2 import Switches, first_splats
from splatcore.reconstruct import drain, reconstruct
from splatcore.reconstruction import Reconstruction
from splatcore.scan import Scan
from splatcore.scene import scene_of
from splatcore.scores import psnr
from splatcore.simulate import Simulation
from splatcore.splats import Splats
from splatcore.tiff import read_stack
from splatcore.variation import Variation

from . import scenes
from .phantom import scan_of

GRID = VolumeGrid((20, 20, 20), (0.1, 0.1, 0.1))  # the cube from -1 to 1
RULES = Rules(gradient=1.0, large=0.2, faintest=1e-5)


def population(n: int = 60, seed: int = 0) -> Splats:
    """Inside GRID, a third of them larger than `RULES.large`."""
    rng = np.random.default_rng(seed)
    scales = rng.uniform(0.02, 0.1, (n, 3))
    scales[::3] *= 5
    scales[::3, 0] = 0.3
    return Splats(
        rng.uniform(-0.4, 0.4, (n, 3)).astype(np.float32),
        scales.astype(np.float32),
        rng.normal(0, 1, (n, 4)).astype(np.float32),
        rng.uniform(0.1, 1, n).astype(np.float32),
    )


def hard(n: int, *rows: int) -> np.ndarray:
    gradient = np.zeros(n, np.float32)
    gradient[list(rows)] = 2.0
    return gradient


def test_nothing_pulls_nothing_changes() -> None:
    before = population()
    after, parent = densify(before, hard(60), RULES, GRID, np.random.default_rng(0))
    assert np.array_equal(parent, np.arange(60))
    assert all(np.array_equal(a, b) for a, b in zip(before.arrays(), after.arrays(), strict=True))


def test_a_clone_keeps_the_volume() -> None:
    """The same place, half the density each: the sum of both is the splat that was."""
    before = population()
    small = [1, 4, 31]
    after, parent = densify(before, hard(60, *small), RULES, GRID, np.random.default_rng(0))
    assert len(after) == 63 and (parent == -1).sum() == 3
    assert after.density.sum() == pytest.approx(before.density.sum(), rel=1e-6)
    assert np.abs(after.voxelize(GRID, 1) - before.voxelize(GRID, 1)).max() < 1e-5 * before.density.max()


def test_a_split_makes_two_smaller_ones_where_one_was() -> None:
    before = population()
    wide = VolumeGrid((4, 4, 4), (2.0, 2.0, 2.0))  # no half leaves it
    large = [0, 3, 57]
    halves = []
    for seed in range(200):
        after, parent = densify(before, hard(60, *large), RULES, wide, np.random.default_rng(seed))
        assert len(after) == 63 and (parent == -1).sum() == 6
        assert not set(large) & set(parent.tolist())
        new = parent == -1
        np.testing.assert_allclose(after.scales[new], before.scales[np.repeat(large, 2)] / 1.6, rtol=1e-6)
        np.testing.assert_allclose(after.density[new], before.density[np.repeat(large, 2)] / 2, rtol=1e-6)
        assert np.array_equal(after.quats[new], before.quats[np.repeat(large, 2)])
        halves.append(after.means[new][:2])
    # Drawn from the splat's own normal distribution: 400 draws show mean and covariance to about a tenth.
    drawn = np.concatenate(halves) - before.means[0]
    w, x, y, z = before.quats[0] / np.linalg.norm(before.quats[0])
    turn = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    own = drawn @ turn / before.scales[0]
    np.testing.assert_allclose(own.mean(axis=0), 0, atol=0.2)
    np.testing.assert_allclose(np.cov(own.T), np.eye(3), atol=0.3)


def test_faint_ones_and_those_outside_are_dropped() -> None:
    before = population()
    before.density[[5, 6]] = [9e-6, 1.1e-5]
    before.means[7] = [0, 0, 1.01]
    before.means[8] = [0, -0.99, 0]
    _, parent = densify(before, hard(60), RULES, GRID, np.random.default_rng(0))
    assert sorted(set(range(60)) - set(parent.tolist())) == [5, 7]


def test_adam_goes_on_for_those_that_stay() -> None:
    """A population that is turned round and joined by a new splat: the old ones move as if nothing had happened."""
    frame = scenes.frames("cone", 1, 24, 24).packed()[0]
    rng = np.random.default_rng(1)
    targets = rng.uniform(0, 0.3, (4, 24, 24)).astype(np.float32)

    def descent(splats: Splats) -> Descent:
        return Descent(
            splats, 24, 24, voxel_mm=1.0, density_unit=0.01, steps=10, rates=Rates(), huber=1e-3, dssim=0.0,
            data_range=1.0, threads=1, scale_limits=(0.1, 100.0),
        )  # fmt: skip

    c = scenes.cloud(30)
    splats = Splats(*(t.numpy().astype(np.float32) for t in c.tensors()))
    straight, turned = descent(splats), descent(splats)
    for target in targets[:2]:
        straight.step(frame, True, target, None)
        turned.step(frame, True, target, None)
    order = np.concatenate([np.arange(30)[::-1], [0]])
    joined = Splats(*(a[order].copy() for a in turned.splats.arrays()))
    joined.density[-1] = 1e-12  # the newcomer adds nothing to the image
    turned.repopulate(joined, np.concatenate([order[:-1], [-1]]).astype(np.intp))
    for target in targets[2:]:
        straight.step(frame, True, target, None)
        turned.step(frame, True, target, None)
    for ours, theirs in zip(turned.splats.arrays(), straight.splats.arrays(), strict=True):
        np.testing.assert_allclose(ours[:-1][::-1], theirs, rtol=2e-4, atol=2e-4)
    # The newcomer's first step is Adam's for zero moments, (0.1 g / 0.32 g at step 3), not that of its neighbour.
    assert not np.allclose(turned.splats.means[-1], straight.splats.means[0], rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("beam", ["cone", "parallel"])
def test_the_screen_gradient_is_that_of_the_projected_centre(beam: Beam) -> None:
    """Moving a splat along u at its depth by what half a detector is there, by finite differences of the loss."""
    c = scenes.cloud(5, sigma=60.0, spread=40.0)
    c = scenes.Cloud(c.means, c.scales.clamp(min=60.0), c.quats, c.density)  # no pixel is near the cutoff
    view = scenes.frames(beam)[2:3]
    frame, cone = view.packed()[0], beam == "cone"
    rows, cols = scenes.ROWS, scenes.COLS
    target = torch.rand(rows, cols, generator=torch.Generator().manual_seed(0), dtype=torch.float64)

    def loss(means: torch.Tensor) -> torch.Tensor:
        image = ops.render(means, *c.tensors()[1:], scenes.NO_MOTION, torch.tensor(frame), cone, rows, cols)
        return ((image - target) ** 2).mean()

    means = c.means.clone().requires_grad_()
    (slope,) = torch.autograd.grad(loss(means), means)
    screen = ScreenGradient(5, rows, cols, cone)
    screen.add(frame, c.means.numpy().astype(np.float32), slope.numpy().astype(np.float32))
    depth = (view.pixel_from_world()[0] @ (c.means.numpy() - view.origin()).T)[2] if cone else np.ones(5)
    for k in range(5):
        expected = []
        for axis, size in ((2, cols), (3, rows)):
            h = 1e-4 * depth[k] * frame[axis] * size / 2
            plus, minus = c.means.clone(), c.means.clone()
            plus[k] += torch.tensor(h)
            minus[k] -= torch.tensor(h)
            expected.append(float(loss(plus) - loss(minus)) / 2e-4)
        assert screen.mean()[k] == pytest.approx(np.hypot(*expected), rel=1e-4)


def test_the_screen_gradient_counts_views_that_show_the_splat() -> None:
    frame = scenes.frames("cone").packed()[0]
    screen = ScreenGradient(2, 10, 10, True)
    means, pull = np.zeros((2, 3), np.float32), np.ones((2, 3), np.float32)
    screen.add(frame, means, pull)
    once = screen.mean().copy()
    screen.add(frame, means, pull * np.array([[1], [0]], np.float32))
    np.testing.assert_allclose(screen.mean(), once, rtol=1e-6)


def total_variation(volume: np.ndarray, threads: int = 1) -> tuple[float, np.ndarray]:
    gradient = np.full_like(volume, np.nan)
    return _native.total_variation(volume, gradient, threads), gradient


def test_total_variation_gradient(isa: str) -> None:
    """Finite differences in double precision."""
    volume = np.random.default_rng(0).uniform(0, 1, (4, 5, 6))
    value, gradient = total_variation(volume)
    pairs = 3 * 5 * 6 + 4 * 4 * 6 + 4 * 5 * 5
    differences = [np.abs(np.diff(volume, axis=axis)).sum() for axis in range(3)]
    assert value == pytest.approx(sum(differences) / pairs, rel=1e-12)
    for index in np.ndindex(volume.shape):
        plus, minus = volume.copy(), volume.copy()
        plus[index] += 1e-7
        minus[index] -= 1e-7
        slope = (total_variation(plus)[0] - total_variation(minus)[0]) / 2e-7
        assert gradient[index] == pytest.approx(slope, abs=1e-8)


@pytest.mark.parametrize("shape", [(1, 1, 1), (1, 7, 1), (3, 1, 5), (9, 10, 37), (64, 64, 64)])
def test_total_variation_is_that_of_differences_with_any_number_of_threads(isa: str, shape: tuple[int, ...]) -> None:
    """Small whole numbers, so that many neighbours are equal."""
    volume = np.random.default_rng(1).integers(0, 3, shape).astype(np.float32)
    differences = [np.diff(volume, axis=axis) for axis in range(3)]
    pairs = max(1, sum(each.size for each in differences))
    expected = np.zeros_like(volume)
    for axis, each in enumerate(differences):
        along, slope = np.moveaxis(expected, axis, 0), np.moveaxis(np.sign(each), axis, 0)
        along[1:] += slope
        along[:-1] -= slope
    value, gradient = total_variation(volume)
    assert value == pytest.approx(sum(float(np.abs(each).sum()) for each in differences) / pairs, rel=1e-6)
    assert np.array_equal(gradient, expected / np.float32(pairs))
    again, other = total_variation(volume, threads=2)
    assert again == value and np.array_equal(other, gradient)


def test_total_variation_wants_arrays_of_one_shape() -> None:
    with pytest.raises(ValueError, match="gradient must have the shape of volume"):
        _native.total_variation(np.zeros((2, 3, 4)), np.zeros((2, 3, 3)), 1)


def test_variation_of_a_volume_as_small_as_the_box() -> None:
    """The box is then the volume itself, and leaving out what does not reach it changes nothing."""
    grid, splats = VolumeGrid((20, 18, 16), (0.1, 0.1, 0.1)), population()
    splats.means[:3] = [[3.0, 0, 0], [0, -4.0, 0], [0.9, 0.9, 1.1]]
    gradient = splats.zeros_like()
    term = Variation(grid, 0.05, 1)
    value = term.add_gradient(splats, gradient, np.random.default_rng(0))
    expected, slope = total_variation(splats.voxelize(grid, 1))
    assert value == pytest.approx(0.05 * expected, rel=1e-5)
    whole = splats.zeros_like()
    box = np.array([grid.voxel_mm, grid.center_mm])
    _native.voxelize_vjp(box, *splats.arrays(), np.ascontiguousarray(0.05 * slope, np.float32), *whole.arrays(), 1)
    for ours, theirs in zip(gradient.arrays(), whole.arrays(), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-4, atol=1e-6 * np.abs(theirs).max())
    term.add_gradient(splats, gradient, np.random.default_rng(0))  # adds, does not overwrite
    np.testing.assert_allclose(gradient.density, 2 * whole.density, rtol=1e-4, atol=1e-6)


# ---- the loops ------------------------------------------------------------------------------------------

WHAT = Simulation(views=24, det=64, sigma_rot=0.06, sigma_trans=0.5, seed=3)


@pytest.fixture(scope="module")
def scan(tmp_path_factory: pytest.TempPathFactory) -> Scan:
    return scan_of(tmp_path_factory.mktemp("r2"), WHAT, edge=32)


def truth(scan: Scan) -> np.ndarray:
    assert scan.folder is not None
    return read_stack(scan.folder / "truth.tif", "truth")


def run(scan: Scan, method: str, steps: int, switches: Switches | None = None) -> Reconstruction:
    options = Options.from_dict({"method": method, "steps": steps, "splats": 2500, "threads": 1})
    return drain(r2.reconstruct(scan, options, switches))


def test_units_cancel(scan: Scan) -> None:
    """What leaves the scene in mm is what the scan's own start was."""
    scene = scene_of(scan, 1)
    assert max(n * v for n, v in zip(scene.grid.shape, scene.grid.voxel_mm, strict=True)) == pytest.approx(2)
    splats = first_splats(scene, 2500, np.random.default_rng(0))
    image = np.empty((64, 64), np.float32)
    _native.Renderer32(64, 64, 1).render(scene.frames.packed()[3], True, *splats.arrays(), image)
    mm = np.empty_like(image)
    _native.Renderer32(64, 64, 1).render(scan.frames.packed()[3], True, *scene.splats_mm(splats).arrays(), mm)
    np.testing.assert_allclose(mm, image * scene.unit * scene.length_mm, rtol=1e-3, atol=1e-4 * mm.max())
    np.testing.assert_allclose(scene.images[3] * scene.unit * scene.length_mm, scan.projections[3], rtol=1e-5)


def test_first_splats(scan: Scan) -> None:
    """At voxel centres of what is not empty, each as wide as its three nearest neighbours are far."""
    scene = scene_of(scan, 1)
    splats = first_splats(scene, 400, np.random.default_rng(0))
    index = (splats.means[:, ::-1] - np.array(scene.grid.center_mm)[::-1]) / np.array(scene.grid.voxel_mm) + 15.5
    np.testing.assert_allclose(index, np.round(index), atol=1e-3)
    k, j, i = np.round(index).astype(int).T
    np.testing.assert_allclose(splats.density, 0.15 * scene.volume[k, j, i], rtol=1e-5)
    assert splats.density.min() > 0.15 * 0.05
    distance = np.sort(np.linalg.norm(splats.means[7] - splats.means, axis=1))[1:4]
    np.testing.assert_allclose(splats.scales[7], np.sqrt((distance**2).mean()), rtol=1e-4)


def test_r2_improves_on_its_start_and_moves_no_view(scan: Scan) -> None:
    result = run(scan, "r2", 240)
    assert np.array_equal(result.corrected.source, scan.frames.source)
    assert result.options.calibrate == "none"
    # 21.8 and 25.1 dB observed
    assert psnr(result.volume, truth(scan), 0.01) > psnr(start_of(scan), truth(scan), 0.01) + 2.5


def test_paper_lowers_the_pose_error_and_gains_by_it(scan: Scan) -> None:
    """A short run whose poses go about as far as in 30,000 steps."""
    fixed = run(scan, "paper", 960, Switches(moving=False))
    paper = run(scan, "paper", 960, Switches(pose_rate=15.0))
    true = true_frames(scan)
    similarity, aligned = align(true, paper.corrected)
    before, after = (pose_errors(true, frames).vectors() for frames in (align(true, scan.frames)[1], aligned))
    # 6.4 and 5.4 degrees, 0.9 and 0.4 voxels observed
    assert rms(after[0]) < 0.9 * rms(before[0]) and rms(after[1]) < 0.6 * rms(before[1])
    moved = paper.splats.moved(similarity).voxelize(scan.volume, 1)
    # 26.8 and 27.7 dB observed
    assert psnr(moved, truth(scan), 0.01) > psnr(fixed.volume, truth(scan), 0.01) + 0.5


def rms(vectors: np.ndarray) -> float:
    return float(np.sqrt((vectors**2).sum(axis=1).mean()))


def true_frames(scan: Scan) -> Frames:
    assert scan.simulation is not None
    given = scan.simulation["frames"]
    return replace(
        scan.frames,
        **{key: np.array([frame[key] for frame in given]) for key in ("source", "detector_center", "u", "v")},
    )


def start_of(scan: Scan) -> np.ndarray:
    """The volume of the first splats."""
    scene = scene_of(scan, 1)
    return scene.splats_mm(first_splats(scene, 2500, np.random.default_rng(0))).voxelize(scan.volume, 1)


def test_switches_change_what_they_name(scan: Scan) -> None:
    """Few steps: enough to see that each switch reaches the loop, with all else equal."""
    plain = run(scan, "paper", 120)
    for switches in (Switches(variation=True), Switches(covariance_path=False), Switches(moving=False)):
        other = run(scan, "paper", 120, switches)
        assert not np.array_equal(other.volume, plain.volume)
        moves = np.abs(other.corrected.source - scan.frames.source).max() > 0
        assert moves == (switches.moving is not False)


def test_the_engine_dispatches_by_method(scan: Scan) -> None:
    events = list(reconstruct(scan, Options(method="r2", steps=40, splats=500, threads=1)))
    fractions = [event.fraction for event in events]
    assert fractions == sorted(fractions) and fractions[0] == 0 and fractions[-1] == 1
    assert events[-1].stage == "done" and any(event.splats == 500 for event in events)


def test_options_that_cannot_be() -> None:
    with pytest.raises(OptionsError, match="steps"):
        Options(steps=100)
    with pytest.raises(OptionsError, match="method"):
        Options.from_dict({"method": "nerf"})


def test_paper_refuses_static(scan: Scan) -> None:
    with pytest.raises(OptionsError, match="single views"):
        drain(reconstruct(scan, Options(method="paper", calibrate="static")))


def test_empty_projections_are_refused(scan: Scan) -> None:
    with pytest.raises(ReconstructionError, match="empty"):
        drain(reconstruct(replace(scan, projections=np.zeros_like(scan.projections)), Options(method="r2")))
