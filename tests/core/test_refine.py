"""The last stage: two halves of the views choose how much total variation the volume gets, and no pose moves."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from splatcore.calibration import Calibration
from splatcore.descent import Descent, Rates
from splatcore.errors import ReconstructionError
from splatcore.gate import Decision
from splatcore.grid import VolumeGrid
from splatcore.options import Options
from splatcore.progress import Progress
from splatcore.pyramid import level
from splatcore.reconstruct import drain, reconstruct
from splatcore.reconstruction import Reconstruction
from splatcore.refine import WEIGHTS, Refinement, Weighing, refine
from splatcore.scan import Scan, read_scan
from splatcore.scores import psnr
from splatcore.simulate import Simulation, simulate
from splatcore.start import first_splats

from .phantom import phantom

EDGE = 32
NOISY = Simulation(views=30, det=64, noise="r2", seed=2)
FIXED = Options(calibrate="none", rotation="given", threads=1)


def sharp() -> np.ndarray:
    return (phantom(EDGE) > 0.3).astype(np.float32)


def scan_of(volume: np.ndarray, folder: Path) -> Scan:
    simulate(volume, folder, NOISY, threads=1, name="object")
    return read_scan(folder)


def weighing(result: Reconstruction) -> dict:
    found = [finding for finding in result.report["findings"] if finding["name"] == "smoothness of the volume"]
    assert len(found) == 1 and found[0]["text"]
    return found[0]["evidence"]


def descent_of(scan: Scan, unit: float = 1.0) -> Descent:
    here = level(scan, 1)
    splats, typical = first_splats(here.images, here.nominal, here.grid, 2000, np.random.default_rng(0), 1)
    return Descent(
        splats, 64, 64, voxel_mm=here.voxel_mm, density_unit=typical, steps=50, rates=Rates(), huber=1e-4 * unit,
        dssim=0.0, data_range=unit, threads=1,
    )  # fmt: skip


@pytest.fixture(scope="module")
def sharp_result(tmp_path_factory: pytest.TempPathFactory) -> tuple[Scan, Reconstruction, list[Progress]]:
    scan = scan_of(sharp(), tmp_path_factory.mktemp("sharp"))
    events, run = [], reconstruct(scan, FIXED)
    while True:
        try:
            events.append(next(run))
        except StopIteration as end:
            return scan, end.value, events


@pytest.mark.slow
def test_a_sharp_object_is_given_variation(sharp_result):
    evidence = weighing(sharp_result[1])
    assert evidence["weight"] > 0
    assert evidence[f"apart_at_{evidence['weight']:g}"] < evidence["apart_at_0"]


@pytest.mark.slow
def test_a_weight_that_does_harm_is_refused(sharp_result, monkeypatch):
    monkeypatch.setattr("splatcore.refine.WEIGHTS", (0.0, 5.0, 10.0))
    evidence = weighing(drain(reconstruct(sharp_result[0], FIXED)))
    assert evidence["weight"] == 0 and evidence["apart_at_5"] > evidence["apart_at_0"]
    assert "apart_at_10" not in evidence  # not asked for more once less had lost


@pytest.mark.slow
def test_the_choice_is_the_better_volume(sharp_result, monkeypatch):
    scan, chosen, _ = sharp_result
    monkeypatch.setattr("splatcore.refine.WEIGHTS", (0.0,))
    plain = drain(reconstruct(scan, FIXED))
    truth = sharp() * np.float32(0.01)
    assert psnr(chosen.volume, truth, 0.01) > psnr(plain.volume, truth, 0.01) + 0.5


def test_a_loss_that_is_no_number_ends_the_last_stage(tmp_path, monkeypatch):
    """As it does the levels before."""
    scan = scan_of(sharp(), tmp_path)
    descent, here = descent_of(scan), level(scan, 1)
    branch = Refinement(descent, here, np.arange(4), 0.0, np.random.default_rng(0))
    measure, calls = Descent.differentiate, []

    def spoiled(self, *given):
        calls.append(1)
        return np.nan if len(calls) == 3 else measure(self, *given)

    monkeypatch.setattr(Descent, "differentiate", spoiled)
    with pytest.raises(ReconstructionError, match="the loss became nan in the last stage, step 4"):
        list(branch.run(here.nominal, 20))


@pytest.mark.slow
@pytest.mark.parametrize("freedom", ["gate", "option"])
def test_no_sigma_is_stated_where_no_view_was_moved(sharp_result, freedom):
    """Whether the option said so, or views left out did."""
    scan, result, _ = sharp_result
    assert np.isnan(result.sigma_rotation_deg).all() and np.isnan(result.sigma_translation_mm).all()
    options = Options(calibrate="none" if freedom == "option" else "full", threads=1)
    calibration = Calibration(scan, options)
    calibration.decision = Decision("none", calibration.motions) if freedom == "gate" else None
    here = level(scan, 1)
    calibration.normals = calibration.accumulate(here, descent_of(scan))
    sigma = calibration.sigmas(here, descent_of(scan), scan.frames)
    assert all(np.isnan(one).all() for one in sigma)


@pytest.mark.slow
def test_the_last_stage_moves_no_view(tmp_path):
    simulate(sharp(), tmp_path, replace(NOISY, views=16), threads=1, name="object")
    events = list(reconstruct(read_scan(tmp_path), replace(FIXED, calibrate="full")))
    last = [event for event in events if event.stage == "refine"]
    assert len(last) > 10 and all(event.moved_deg is None for event in last)
    assert any(event.moved_deg is not None for event in events)


@pytest.mark.slow
def test_progress_grows_through_it(sharp_result):
    fractions = [event.fraction for event in sharp_result[2] if event.stage == "refine"]
    assert fractions == sorted(fractions) and fractions[-1] > fractions[0] + 0.2


def test_a_preview_does_without(tmp_path):
    result = drain(reconstruct(scan_of(sharp(), tmp_path), replace(FIXED, quality="preview")))
    assert not [finding for finding in result.report["findings"] if finding["name"] == "smoothness of the volume"]


@pytest.mark.slow
def test_too_few_views_to_choose_get_some(tmp_path):
    simulate(sharp(), tmp_path, replace(NOISY, views=12), threads=1, name="few")
    evidence = weighing(drain(reconstruct(read_scan(tmp_path), FIXED)))
    assert evidence == {"weight": 0.02, "further": True}
    assert 0.02 in WEIGHTS


def test_a_branch_goes_its_own_way(tmp_path):
    scan = scan_of(sharp(), tmp_path)
    here, trunk = level(scan, 1), descent_of(scan)
    packed = here.nominal.packed()
    for view in range(5):
        trunk.step(packed[view], True, here.images[view], None)
    before = [array.copy() for array in trunk.splats.arrays()]
    branches = [trunk.branch(20, Rates(end=0.15), 1e-3) for _ in range(2)]
    for view in range(5, 10):
        for branch in branches:
            branch.step(packed[view], True, here.images[view], None)
    for was, is_now in zip(before, trunk.splats.arrays(), strict=True):
        np.testing.assert_array_equal(was, is_now)
    for one, other in zip(branches[0].splats.arrays(), branches[1].splats.arrays(), strict=True):
        np.testing.assert_array_equal(one, other)
    assert not np.array_equal(branches[0].splats.means, trunk.splats.means)


def test_a_branch_keeps_its_momentum(tmp_path):
    scan = scan_of(sharp(), tmp_path)
    here, trunk = level(scan, 1), descent_of(scan)
    frame = here.nominal.packed()[0]
    for _ in range(5):
        trunk.step(frame, True, here.images[0], None)
    branch = trunk.branch(50, replace(Rates(), end=1.0), 1e-4)
    trunk._rates, trunk._steps = replace(Rates(), end=1.0), 50  # so that nothing but the moments could differ
    trunk.step(frame, True, here.images[0], None)
    branch.step(frame, True, here.images[0], None)
    np.testing.assert_array_equal(branch.splats.means, trunk.splats.means)


@pytest.mark.parametrize("power", [-10, 13])
def test_no_unit_of_the_line_integrals_matters(tmp_path, power):
    """Mean loss, D-SSIM, variation and Adam's moments keep their proportion: the same splats, as much denser."""
    plain = scan_of(sharp(), tmp_path)
    moved = {}
    for unit in (1.0, 2.0**power):
        scan = replace(plain, projections=plain.projections * np.float32(unit))
        here, trunk = level(scan, 1), descent_of(scan, unit)
        packed = here.nominal.packed()
        for view in range(10):
            trunk.step(packed[view], True, here.images[view], None)
        stage, steps = refine(Weighing(0.02, trunk), here, here.nominal, 60, np.random.default_rng(0))
        list(stage.run(here.nominal, steps))
        moved[unit] = stage.descent.splats
    one, other = moved.values()
    away = np.abs(one.means - other.means).max(axis=1) / here.voxel_mm
    assert np.quantile(away, 0.99) < 0.01
    assert np.quantile(np.abs(other.density / (one.density * unit) - 1), 0.99) < 0.01


def test_where_the_images_hold_no_more_the_volume_stays(tmp_path):
    scan = scan_of(sharp(), tmp_path)
    here, trunk = level(scan, 1), descent_of(scan)
    rng = np.random.default_rng(0)
    for weight, further, steps in ((0.0, False, 0), (0.0, True, 1500), (0.02, True, 3000)):
        assert refine(Weighing(weight, trunk, further), here, here.nominal, 3000, rng)[1] == steps


@pytest.mark.slow
@pytest.mark.parametrize(
    ("what", "further"), [({"noise": "none", "views": 60}, True), ({"i0": 1000.0, "views": 24}, False)]
)
def test_two_halves_say_whether_going_on_helps(tmp_path, monkeypatch, what, further):
    """Without noise there is nothing wrong to be followed; in a few noisy views there is (22.2 in place of 22.6 dB)."""
    monkeypatch.setattr("splatcore.refine.WEIGHTS", (0.0,))
    simulate(sharp(), tmp_path, replace(NOISY, **what), threads=1, name="object")
    evidence = weighing(drain(reconstruct(read_scan(tmp_path), FIXED)))
    assert evidence["weight"] == 0 and evidence["further"] is further


def test_a_population_that_is_all_new_begins_like_a_first_one(tmp_path):
    """Without the moments' first steps, which Adam corrects for, it would begin with steps three times as long."""
    scan = scan_of(sharp(), tmp_path)
    here, first, worn = level(scan, 1), descent_of(scan), descent_of(scan)
    frame, splats = here.nominal.packed()[0], descent_of(scan).splats
    for _ in range(5):
        worn.step(frame, True, here.images[0], None)
    again = worn.branch(50, Rates(), 1e-4)
    again.repopulate(splats, np.full(len(splats), -1))
    for descent in (first, again):
        descent.step(frame, True, here.images[0], None)
    for one, other in zip(first.splats.arrays(), again.splats.arrays(), strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize(("edge", "box"), [(32, 32), (128, 32), (256, 64)])
def test_the_box_of_the_variation_grows_with_the_volume(tmp_path, edge, box):
    scan = scan_of(sharp(), tmp_path)
    here = level(scan, 1)
    fine = replace(here, grid=VolumeGrid((edge,) * 3, here.grid.voxel_mm, here.grid.center_mm))
    refinement = Refinement(descent_of(scan), fine, np.arange(4), 0.02, np.random.default_rng(0))
    assert refinement._variation is not None and refinement._variation.box == box


@pytest.mark.slow
@pytest.mark.parametrize("spoiled", ["order", "every second empty"])
def test_halves_are_sound_whatever_the_order_of_the_views(tmp_path, spoiled):
    """Views listed so that every second one lies on one side would make halves of two arcs; a half of empty images
    cannot be chosen by."""
    scan = scan_of(sharp(), tmp_path)
    if spoiled == "order":
        mixed = np.arange(30).reshape(2, 15).T.ravel()  # 0, 15, 1, 16, ...
        scan = replace(scan, projections=scan.projections[mixed], frames=scan.frames[mixed])
        assert weighing(drain(reconstruct(scan, FIXED)))["weight"] > 0
    else:
        projections = scan.projections.copy()
        projections[1::2] = 0
        evidence = weighing(drain(reconstruct(replace(scan, projections=projections), FIXED)))
        assert evidence["weight"] == 0.02 and "apart_at_0" not in evidence
