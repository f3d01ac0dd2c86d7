"""Scores of results against the truth: exact on a perfect result, blind to what no projection can tell."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import tifffile

from splatcore.errors import ScanError
from splatcore.evaluate import evaluate, table
from splatcore.gauge import moved_frames
from splatcore.geometry import RigidMotions, rotation_from_vector
from splatcore.options import Options
from splatcore.reconstruct import drain, reconstruct
from splatcore.results import write_results
from splatcore.simulate import Simulation
from splatcore.splats import Similarity

from .phantom import scan_of


@pytest.fixture(scope="module")
def perfect(tmp_path_factory):
    """A scan whose truth is the reconstruction itself, seen from the nominal frames."""
    folder = tmp_path_factory.mktemp("perfect")
    scan = scan_of(folder, Simulation(views=16, det=48, noise="none"), edge=24)
    result = drain(reconstruct(scan, Options(quality="preview", calibrate="none", threads=1)))
    tifffile.imwrite(folder / "truth.tif", result.volume)
    return folder, result


def test_a_perfect_result(perfect, tmp_path):
    folder, result = perfect
    write_results(result, tmp_path)
    scores = evaluate(tmp_path, folder)
    assert scores["psnr"] > 140 and scores["ssim"] == pytest.approx(1)
    for name in ("rot_deg", "trans_vox", "rpe_px"):
        assert scores[name] == pytest.approx(0, abs=1e-6) and scores[name + "_aligned"] == pytest.approx(0, abs=1e-6)


def test_alignment_removes_the_gauge_and_nothing_else(perfect, tmp_path):
    folder, result = perfect
    moved = Similarity(rotation_from_vector(np.array([0.01, -0.02, 0.015])), np.array([1.0, -2.0, 0.5]), 1.02)
    elsewhere = replace(
        result,
        corrected=moved_frames(result.corrected, moved),
        splats=result.splats.moved(moved),
        volume=result.splats.moved(moved).voxelize(result.grid, 1),
    )
    write_results(elsewhere, tmp_path)
    scores = evaluate(tmp_path, folder)
    assert scores["psnr"] < 40 and scores["psnr_aligned"] > 90
    assert scores["rot_deg"] > 1 and scores["rot_deg_aligned"] < 1e-6
    assert scores["trans_vox"] > 0.2 and scores["trans_vox_aligned"] < 1e-6
    assert scores["rpe_px_aligned"] < 1e-6


def test_errors_of_single_views_are_not_aligned_away(perfect, tmp_path):
    folder, result = perfect
    omega = np.zeros((16, 3))
    omega[::2, 2], omega[1::2, 2] = 0.01, -0.01
    wrong = replace(result, corrected=RigidMotions.exp(omega, np.zeros((16, 3))).correct(result.nominal))
    write_results(wrong, tmp_path)
    scores = evaluate(tmp_path, folder)
    assert scores["rot_deg_aligned"] == pytest.approx(np.rad2deg(0.01), rel=1e-3)


def test_a_scan_without_truth_is_refused(perfect, tmp_path):
    folder, result = perfect
    write_results(result, tmp_path / "out")
    bare = tmp_path / "scan"
    bare.mkdir()
    document = json.loads((folder / "scan.json").read_text())
    del document["simulation"]
    (bare / "scan.json").write_text(json.dumps(document))
    (bare / "projections.tif").write_bytes((folder / "projections.tif").read_bytes())
    with pytest.raises(ScanError, match="truth"):
        evaluate(tmp_path / "out", bare)


def test_another_scan_is_refused(perfect, tmp_path):
    _, result = perfect
    write_results(result, tmp_path / "out")
    scan_of(tmp_path / "other", Simulation(views=9, det=48), edge=24)
    with pytest.raises(ScanError, match="frames"):
        evaluate(tmp_path / "out", tmp_path / "other")


def test_the_table_shows_before_after_and_aligned(perfect, tmp_path):
    folder, result = perfect
    write_results(result, tmp_path)
    text = table(evaluate(tmp_path, folder))
    assert all(word in text for word in ("before", "after", "aligned", "PSNR", "rotation", "reprojection"))
