"""Result folders: whole or not at all, and the same when read back."""

from __future__ import annotations

import dataclasses
import errno
import hashlib
import json
import resource
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile

from splatcore import results
from splatcore.errors import ResultError, ScanError
from splatcore.geometry import RigidMotions, circular
from splatcore.grid import VolumeGrid
from splatcore.options import Options
from splatcore.posefile import read_poses
from splatcore.reconstruction import Reconstruction
from splatcore.results import prepare_folder, read_results, write_results, write_volume
from splatcore.splats import Splats

VIEWS = 5
FILES = {"volume.tif", "splats.npz", "poses.json", "report.json", "report.html", "manifest.json"}


def reconstruction(beam: Any = "cone", **changes: Any) -> Reconstruction:
    rng = np.random.default_rng(0)
    grid = VolumeGrid((4, 5, 6), (1.0, 2.0, 0.5), (1.0, 2.0, 3.0))
    nominal = circular(beam, np.arange(VIEWS) * 72.0, 500, 700, 12, 16, (2.0, 1.5))
    corrections = RigidMotions.exp(rng.normal(0, 0.02, (VIEWS, 3)), rng.normal(0, 0.5, (VIEWS, 3)))
    sigma = rng.random((VIEWS, 3))
    splats = Splats(*(rng.random(shape, np.float32) for shape in ((7, 3), (7, 3), (7, 4), (7,))))
    made = Reconstruction(
        scan_name="teapot",
        splats=splats,
        volume=rng.random(grid.shape, np.float32),
        grid=grid,
        nominal=nominal,
        corrected=corrections.correct(nominal),
        corrections=corrections,
        sigma_rotation_deg=sigma,
        sigma_translation_mm=2 * sigma,
        residual_rms=rng.random(VIEWS),
        static={"cor_px": 1.25},
        gauge="mean correction zero",
        report={"format": "splatct-report/1", "scan": "teapot", "verdict": "Fine.", "summary": {"n": np.float32(0.5)}},
        options=Options(seed=7),
        timings={"total": 1.5},
    )
    return dataclasses.replace(made, **changes)


def test_round_trip(tmp_path: Path) -> None:
    made = reconstruction()
    manifest = write_results(made, tmp_path / "deep" / "out")
    read = read_results(tmp_path / "deep" / "out", verify=True)
    np.testing.assert_array_equal(read.volume, made.volume)
    assert read.grid == made.grid
    for ours, theirs in zip(read.splats.arrays(), made.splats.arrays(), strict=True):
        np.testing.assert_array_equal(ours, theirs)
    assert read.frames.to_json() == made.corrected.to_json()
    assert (read.frames.rows, read.frames.cols) == (12, 16)
    assert read.report["summary"] == {"n": 0.5}
    assert read.manifest == json.loads(json.dumps(manifest))
    assert {path.name for path in read.folder.iterdir()} == FILES, "no temporary file stays"


def test_manifest(tmp_path: Path) -> None:
    manifest = write_results(reconstruction(), tmp_path)
    assert {entry["name"] for entry in manifest["files"]} == FILES - {"manifest.json"}
    for entry in manifest["files"]:
        raw = (tmp_path / entry["name"]).read_bytes()
        assert (entry["size"], entry["sha256"]) == (len(raw), hashlib.sha256(raw).hexdigest())
    assert (manifest["seed"], manifest["device"], manifest["scan"]) == (7, "cpu", "teapot")
    assert manifest["options"] == Options(seed=7).to_dict()
    assert manifest["volume"] == {"shape": [4, 5, 6], "voxel_mm": [1.0, 2.0, 0.5], "center_mm": [1.0, 2.0, 3.0]}
    assert {"splatct", "python", "numpy"} <= set(manifest["versions"])
    assert manifest["timings"] == {"total": 1.5}


def test_volume_file(tmp_path: Path) -> None:
    write_results(reconstruction(), tmp_path)
    with tifffile.TiffFile(tmp_path / "volume.tif") as file:
        assert file.is_bigtiff and len(file.pages) == 4
        page = file.pages[0]
        assert isinstance(page, tifffile.TiffPage)
        assert (page.dtype, page.shape, page.compression) == (np.float32, (5, 6), 1)
        x, y = page.tags["XResolution"].value, page.tags["YResolution"].value
        assert (x[0] / x[1], y[0] / y[1]) == pytest.approx((10 / 0.5, 10 / 2.0))  # voxels per centimetre
        assert page.tags["ResolutionUnit"].value == 3
        described = json.loads(page.description)
        assert (described["voxel_mm"], described["spacing"], described["unit"]) == ([1.0, 2.0, 0.5], 1.0, "mm")


def test_poses_file(tmp_path: Path) -> None:
    made = reconstruction()
    write_results(made, tmp_path)
    poses = json.loads((tmp_path / "poses.json").read_text())
    assert (poses["format"], poses["static"], poses["gauge"]) == (
        "splatct-poses/1",
        {"cor_px": 1.25},
        "mean correction zero",
    )
    omega, tau = made.corrections.vectors()
    for k, view in enumerate(poses["views"]):
        assert set(view) == {"index", "frame", "correction", "sigma", "residual_rms"}
        assert view["index"] == k and view["frame"] == made.corrected.to_json()[k]
        np.testing.assert_allclose(view["correction"]["rotation_deg"], np.rad2deg(omega[k]))
        np.testing.assert_allclose(view["correction"]["translation_mm"], tau[k])
        np.testing.assert_allclose(view["sigma"]["rotation_deg"], made.sigma_rotation_deg[k])
        np.testing.assert_allclose(view["sigma"]["translation_mm"], made.sigma_translation_mm[k])
        assert view["residual_rms"] == made.residual_rms[k]
    assert "notes" not in poses


def test_no_sigma_is_stated_of_views_that_were_not_moved(tmp_path: Path) -> None:
    unmoved = np.full((VIEWS, 3), np.nan)
    write_results(reconstruction("cone", sigma_rotation_deg=unmoved, sigma_translation_mm=unmoved), tmp_path)
    poses = json.loads((tmp_path / "poses.json").read_text())
    nothing = {"rotation_deg": [None] * 3, "translation_mm": [None] * 3}
    assert all(view["sigma"] == nothing for view in poses["views"])
    assert len(poses["notes"]) == 1 and "no view was moved" in poses["notes"][0]


def test_infinite_sigma_is_null_with_a_note(tmp_path: Path) -> None:
    sigma = np.ones((VIEWS, 3))
    sigma[:, 0] = np.inf
    write_results(reconstruction("parallel", sigma_translation_mm=sigma, residual_rms=np.full(VIEWS, np.nan)), tmp_path)
    text = (tmp_path / "poses.json").read_text()
    assert "Infinity" not in text and "NaN" not in text
    poses = json.loads(text)
    assert poses["views"][0]["sigma"]["translation_mm"] == [None, 1.0, 1.0]
    assert poses["views"][0]["residual_rms"] is None
    assert len(poses["notes"]) == 1 and "does not show" in poses["notes"][0]
    assert read_results(tmp_path).frames.beam == "parallel"


def test_poses_alone_can_be_read(tmp_path: Path) -> None:
    """As the design's smallest poses.json: no beam, no detector."""
    made = reconstruction()
    write_results(made, tmp_path)
    poses = json.loads((tmp_path / "poses.json").read_text())
    del poses["beam"], poses["detector"]
    path = tmp_path / "mine.json"
    path.write_text(json.dumps(poses))
    assert read_poses(path, (12, 16))[1].to_json() == made.corrected.to_json()
    with pytest.raises(ScanError, match="/detector: missing"):
        read_poses(path)
    del poses["views"][3]["frame"]["u"]
    poses["format"] = "other"
    path.write_text(json.dumps(poses))
    with pytest.raises(ScanError) as caught:
        read_poses(path, (12, 16))
    assert [problem.where for problem in caught.value.problems] == ["/format", "/views/3/u"]


def test_numbers_json_cannot_hold_are_refused_by_name(tmp_path: Path) -> None:
    report = {"summary": {"loss": [1.0, float("nan")]}}
    with pytest.raises(ResultError, match="/summary/loss/1"):
        write_results(reconstruction(report=report), tmp_path)
    assert not (tmp_path / "manifest.json").exists()


def test_a_folder_with_anything_in_it_is_refused(tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("x")
    with pytest.raises(ResultError, match="not empty"):
        prepare_folder(tmp_path)
    with pytest.raises(ResultError, match="not empty"):
        write_results(reconstruction(), tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {"mine.txt"}
    write_results(reconstruction(), tmp_path, overwrite=True)
    write_results(reconstruction(scan_name="second"), tmp_path, overwrite=True)
    assert read_results(tmp_path, verify=True).manifest["scan"] == "second"
    assert (tmp_path / "mine.txt").read_text() == "x", "what is not ours stays"


def test_odd_folders_are_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("x")
    (tmp_path / "scan").mkdir()
    (tmp_path / "scan" / "scan.json").write_text("{}")
    with pytest.raises(ResultError, match="is a file"):
        prepare_folder(tmp_path / "file")
    with pytest.raises(ResultError, match="cannot be written"):
        prepare_folder(tmp_path / "file" / "below")
    with pytest.raises(ResultError, match="scan folder"):
        prepare_folder(tmp_path / "scan", overwrite=True)


def test_a_failed_write_leaves_no_manifest(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_results(reconstruction(), tmp_path)

    def full(*_: Any, **__: Any) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(results, "_write_splats", full)
    with pytest.raises(ResultError, match="No space left"):
        write_results(reconstruction(), tmp_path, overwrite=True)
    assert {path.name for path in tmp_path.iterdir()} == FILES - {"manifest.json"}
    with pytest.raises(ResultError, match=r"manifest\.json: cannot be read"):
        read_results(tmp_path)


def test_a_volume_that_is_cut_short_tells_why(tmp_path: Path) -> None:
    """numpy raises an error without a number; whether a disk was full decides what becomes of the job."""
    edge, limits = 64, resource.getrlimit(resource.RLIMIT_FSIZE)
    volume, grid = np.zeros((edge, edge, edge), np.float32), VolumeGrid((edge, edge, edge), (1.0, 1.0, 1.0))
    resource.setrlimit(resource.RLIMIT_FSIZE, (volume.nbytes // 2, limits[1]))
    try:
        with pytest.raises(OSError, match="too large") as raised, (tmp_path / "volume.tif").open("wb") as file:
            write_volume(file, volume, grid)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert raised.value.errno == errno.EFBIG


@pytest.mark.parametrize("name", sorted(FILES - {"manifest.json"}))
def test_damage_is_found(tmp_path: Path, name: str) -> None:
    write_results(reconstruction(), tmp_path)
    raw = bytearray((tmp_path / name).read_bytes())
    raw[len(raw) // 2] ^= 1
    (tmp_path / name).write_bytes(raw)
    with pytest.raises(ResultError):
        read_results(tmp_path, verify=True)


@pytest.mark.parametrize("name", sorted(FILES - {"report.html"}))
def test_a_missing_or_cut_file_is_told(tmp_path: Path, name: str) -> None:
    write_results(reconstruction(), tmp_path)
    raw = (tmp_path / name).read_bytes()
    (tmp_path / name).write_bytes(raw[: len(raw) // 2])
    with pytest.raises(ResultError):
        read_results(tmp_path)
    (tmp_path / name).unlink()
    with pytest.raises(ResultError):
        read_results(tmp_path)


def test_a_volume_that_does_not_fit_its_grid_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ResultError, match="shape"):
        write_results(reconstruction(volume=np.zeros((4, 5, 7), np.float32)), tmp_path)
