"""Turning sense and transposition: what the candidates are, and that they are found and named, or left alone."""

from __future__ import annotations

import itertools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from splatcore.geometry import circular
from splatcore.options import Options
from splatcore.orientation import Orientation, find_orientation, finding, mirrored, oriented, reversed_rotation
from splatcore.scan import Scan, read_scan
from splatcore.simulate import Simulation, simulate

from .phantom import scan_of

GIVEN, REVERSED = Orientation(), Orientation(reversed=True)
# The jitter of the paper (0.03 rad, a voxel of 128), and a detector off by three hundredths of its width.
HARD = {"views": 40, "det": 64, "sigma_rot": 0.03, "sigma_trans": 0.25, "offset_px": (2.0, 0.0), "seed": 3}
EDGE = 32


@pytest.fixture(scope="module")
def hard(tmp_path_factory: pytest.TempPathFactory) -> Scan:
    return scan_of(tmp_path_factory.mktemp("hard"), Simulation(**HARD), EDGE)


@pytest.mark.parametrize("beam", ["cone", "parallel"])
def test_reversed_rotation_is_that_of_negated_angles(beam):
    angles = np.array([0.0, 10.0, 75.0, 200.0])
    shape = (500, 700, 30, 40, (1.5, 2.0), (3.0, -7.0))
    found, expected = reversed_rotation(circular(beam, angles, *shape)), circular(beam, -angles, *shape)
    if beam == "cone":
        assert np.allclose(found.source, expected.source)
    for name in ("u", "v"):
        assert np.allclose(getattr(found, name), getattr(expected, name))
    # The detector's offset along u is the world's, so it is mirrored with it; along v it stays.
    offset = found.detector_center - expected.detector_center
    assert np.allclose(offset, 2 * 7.0 * expected.u / 2.0)


def test_mirrored_columns_are_a_reversed_rotation_of_the_mirrored_object():
    frames = circular("cone", np.arange(7) * 50.0, 500, 700, 30, 40, (1.5, 2.0))
    points = np.random.default_rng(0).uniform(-50, 50, (20, 3))
    one = mirrored(frames, columns=True, rows=False).project(points)
    two = reversed_rotation(frames).project(points * [1, -1, 1])
    assert np.allclose(one, two)


def test_candidates_undo_themselves():
    frames = circular("cone", np.arange(7) * 50.0, 500, 700, 32, 32, (2.0, 2.0))
    for turned, swapped in itertools.product((False, True), repeat=2):
        candidate, again = Orientation(turned, swapped), Orientation(transposed=swapped)
        back = Orientation(reversed=turned).apply(again.apply(candidate.apply(frames)))
        assert np.allclose(back.packed(), frames.packed())


def test_a_scan_that_is_right_is_left_alone_in_spite_of_jitter_and_offset(hard):
    verdict = find_orientation(hard, 0, 1)
    assert verdict.tried and verdict.found == GIVEN and not verdict.entries()
    said = finding(verdict, Options())
    assert said["severity"] == "ok" and "as stated" in said["text"]


def test_jitter_of_a_tenth_of_a_radian_does_not_turn_a_scan_round(tmp_path):
    worst = HARD | {"sigma_rot": 0.1, "sigma_trans": 1.25}
    assert find_orientation(scan_of(tmp_path, Simulation(**worst), EDGE), 0, 1).found == GIVEN


@pytest.mark.parametrize("what", [{"reverse": True}, {"flip_u": True}])
def test_wrong_parity_is_found_and_named(tmp_path, what):
    scan = scan_of(tmp_path, Simulation(**(HARD | what)), EDGE)
    turned, verdict = oriented(scan, Options(), 1)
    assert verdict.found == REVERSED and verdict.entries() == {"rotation_reversed": True}
    assert np.allclose(turned.frames.packed(), reversed_rotation(scan.frames).packed())
    said = finding(verdict, Options())
    assert said["severity"] == "warning"
    assert "turns the other way, or the columns are mirrored: the two look the same" in said["text"]


def test_mirrored_rows_do_not_show(tmp_path):
    scan = scan_of(tmp_path, Simulation(**(HARD | {"flip_v": True})), EDGE)
    assert find_orientation(scan, 0, 1).found == GIVEN


def test_transposed_images_are_found_whichever_way_the_table_turns(hard):
    exchanged = replace(hard, projections=np.ascontiguousarray(hard.projections.transpose(0, 2, 1)))
    verdict = find_orientation(exchanged, 0, 1)
    assert verdict.found == Orientation(transposed=True) and verdict.entries() == {"transposed": True}
    assert "exchanged" in finding(verdict, Options())["text"]
    turned = replace(exchanged, frames=reversed_rotation(hard.frames))
    assert find_orientation(turned, 0, 1).found == Orientation(reversed=True, transposed=True)


def test_a_detector_that_is_not_square_is_never_transposed(hard):
    cut = replace(
        hard, projections=np.ascontiguousarray(hard.projections[:, 4:-4]), frames=replace(hard.frames, rows=56)
    )
    assert not any("transposed" in name for name in find_orientation(cut, 0, 1).residual)


def test_a_round_object_looks_the_same_either_way_and_stays_as_given(tmp_path):
    axis = (np.arange(EDGE) + 0.5) / EDGE * 2 - 1
    z, y, x = np.meshgrid(axis, axis, axis, indexing="ij")
    radius = np.hypot(x, y)
    # Soft, or the corners of its voxels tell.
    can = 0.5 / (1 + np.exp((radius - 0.5) / 0.06)) * (abs(z) < 0.6) + 0.4 * np.exp(
        -((radius / 0.3) ** 4) - (z / 0.3) ** 2
    )
    simulate(can.astype(np.float32), tmp_path, Simulation(views=40, det=64, sigma_rot=0.03, sigma_trans=0.3), 1)
    verdict = find_orientation(read_scan(tmp_path), 0, 1)
    assert verdict.found == GIVEN
    said = finding(verdict, Options())
    assert said["severity"] == "note" and "do not say clearly" in said["text"]


def test_a_parallel_beam_cannot_tell(hard):
    frames = circular("parallel", np.arange(40) * 9.0, 500, 700, 64, 56, (4.0, 4.0))
    verdict = find_orientation(replace(hard, frames=frames, projections=hard.projections[:, :, :56]), 0, 1)
    assert not verdict.tried and verdict.found == GIVEN
    assert "parallel beam cannot tell" in finding(verdict, Options())["text"]


def test_options_settle_it(hard):
    turned, verdict = oriented(hard, Options(rotation="reversed", flip_v=True), 1)
    assert not verdict.tried and verdict.found == REVERSED
    expected = reversed_rotation(replace(hard.frames, v=-hard.frames.v))
    assert np.allclose(turned.frames.packed(), expected.packed())
    said = finding(verdict, Options(rotation="reversed", flip_v=True))["text"]
    assert "as the options ask" in said and "rows were taken as mirrored" in said
    given, _ = oriented(hard, Options(rotation="given"), 1)
    assert np.array_equal(given.frames.packed(), hard.frames.packed())


def test_mirrored_columns_settled_by_option_need_no_reversal(tmp_path: Path):
    scan = scan_of(tmp_path, Simulation(**(HARD | {"flip_u": True})), EDGE)
    turned, verdict = oriented(scan, Options(flip_u=True), 1)
    assert verdict.tried and verdict.found == GIVEN
    assert np.array_equal(turned.frames.u, -scan.frames.u)


def test_few_views_are_not_tried(hard):
    few = replace(hard, frames=hard.frames[:5], projections=hard.projections[:5])
    verdict = find_orientation(few, 0, 1)
    assert not verdict.tried and "too few" in finding(verdict, Options())["text"]
