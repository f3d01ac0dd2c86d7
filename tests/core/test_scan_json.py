"""Documents of scans that are wrong: what they are blamed for."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import pytest

from splatcore.errors import ScanError
from splatcore.scan import check_scan, read_scan

from .scanfolder import COLS, ROWS, VIEWS, plain_images, problems, write_scan, write_tiff

WRONG: list[tuple[str, Any, str, str]] = [
    # pointer, value, blamed pointer, words of the message
    ("/format", "splatct-scan/2", "/format", "splatct-scan/1"),
    ("/format", ..., "/format", "missing"),
    ("/geometry", ..., "/geometry", "missing"),
    ("/projections", [], "/projections", "expected an object"),
    ("/geometri", {}, "/geometri", "unknown key"),
    ("/projections/flats", [], "/projections/flats", "did you mean 'flat'?"),
    ("/geometry/dso_m", 1, "/geometry/dso_m", "unknown key"),
    ("/geometry/dso_mm", ..., "/geometry/dso_mm", "missing"),
    ("/geometry/dso_mm", "500", "/geometry/dso_mm", 'got "500"'),
    ("/geometry/dso_mm", True, "/geometry/dso_mm", "got true"),
    ("/geometry/dso_mm", 700, "/geometry/dso_mm", "dso 700 and dsd 700"),
    ("/geometry/dso_mm", 1e308, "/geometry/dso_mm", "expected a number from 0 to 1e+06 mm"),
    ("/geometry/dso_mm", float("nan"), "/geometry/dso_mm", "finite"),
    ("/geometry/dsd_mm", float("inf"), "/geometry/dsd_mm", "finite"),
    ("/geometry/dsd_mm", 10**400, "/geometry/dsd_mm", "expected a number"),
    ("/geometry/beam", "fan", "/geometry/beam", "one of cone, parallel"),
    ("/geometry/angles_deg", [], "/geometry/angles_deg", "is empty"),
    ("/geometry/angles_deg/3", None, "/geometry/angles_deg/3", "got null"),
    ("/geometry/angles_deg", list(range(8)), "/geometry/angles_deg", "has 8 views, but the TIFF files hold 9 pages"),
    ("/geometry/detector/rows", 0, "/geometry/detector/rows", "got 0"),
    ("/geometry/detector/rows", 12.5, "/geometry/detector/rows", "got 12.5"),
    ("/geometry/detector/rows", 10**9, "/geometry/detector/rows", "got 1000000000"),
    ("/geometry/detector/rows", 13, "projections.tif", "12 rows x 16 columns, but scan.json says 13 rows x 16"),
    ("/geometry/detector/pixel_mm", [1.0, 0.0], "/geometry/detector/pixel_mm/1", "got 0.0"),
    ("/geometry/detector/pixel_mm", [1.0], "/geometry/detector/pixel_mm", "has 1 items, expected 2 [v, u]"),
    ("/geometry/detector/pixel_mm", 1.0, "/geometry/detector/pixel_mm", "expected a list of 2"),
    ("/geometry/detector/offset_mm", [0, "a"], "/geometry/detector/offset_mm/1", 'got "a"'),
    ("/projections/kind", "count", "/projections/kind", "did you mean 'counts'?"),
    ("/projections/kind", "counts", "/projections/flat", "missing"),
    ("/projections/scale", 0, "/projections/scale", "other than 0"),
    ("/projections/files", [], "/projections/files", "is empty"),
    ("/projections/files", "projections.tif", "/projections/files", "expected a list"),
    ("/projections/files/0", 7, "/projections/files/0", "expected a file name"),
    ("/projections/files/0", "projektions.tif", "/projections/files/0", "did you mean 'projections.tif'?"),
    ("/projections/files", ["projections.tif", "./projections.tif"], "/projections/files/1", "is the same file as"),
    ("/projections/files/0", "/etc/passwd", "/projections/files/0", "not a plain relative path"),
    ("/projections/files/0", "../secret.tif", "/projections/files/0", "not a plain relative path"),
    ("/projections/files/0", "C:\\secret.tif", "/projections/files/0", "not a plain relative path"),
    ("/projections/files/0", "a\x00b", "/projections/files/0", "not a plain relative path"),
    ("/projections/files/0", "x" * 5000, "/projections/files/0", ""),
    ("/projections/files/0", "secret_link.tif", "/projections/files/0", "leads out of the scan folder"),
    ("/projections/files/0", "loop", "/projections/files/0", ""),
    ("/projections/files/0", "pipe", "/projections/files/0", "not a regular file"),
    ("/projections/files/0", ".", "/projections/files/0", "not a regular file"),
    ("/bad_pixels", "nowhere.tif", "/bad_pixels", "does not exist"),
    ("/time_s", [1.0], "/time_s", "has 1 items, but the geometry has 9 views"),
    ("/exposure", [0.0] * VIEWS, "/exposure/0", "got 0.0"),
    ("/tolerance", {"rotation_deg": -1}, "/tolerance/rotation_deg", "got -1"),
    ("/tolerance", {"rotation": 1}, "/tolerance/rotation", "did you mean 'rotation_deg'?"),
    ("/simulation", 3, "/simulation", "expected an object"),
    ("/simulation", {"deep": [1, {"x": float("nan")}]}, "/simulation/deep/1/x", "finite"),
    ("/volume/shape", [6, 7], "/volume/shape", "expected 3 [z, y, x]"),
    ("/volume/shape", [6, 7, -8], "/volume/shape/2", "got -8"),
    ("/volume/shape", [30000] * 3, "/volume/shape", "voxels, more than"),
    ("/volume/voxel_mm", ..., "/volume/voxel_mm", "missing"),
    ("/volume/voxel_mm", [1, 1, 0], "/volume/voxel_mm/2", "got 0"),
    ("/volume/voxel_mm", [100, 200, 200], "/volume", "source of view 0 lies inside the volume"),
    ("/name", "", "/name", "expected text"),
    ("/name", "a\nb", "/name", "control characters"),
]


@pytest.mark.parametrize(("pointer", "value", "where", "words"), WRONG, ids=[f"{w[0]}={w[1]!r:.30}" for w in WRONG])
def test_wrong_json(tmp_path: Path, pointer: str, value: Any, where: str, words: str) -> None:
    folder = write_scan(tmp_path / "scan", changes={pointer: value})
    write_tiff(tmp_path / "secret.tif", plain_images())
    (folder / "secret_link.tif").symlink_to(tmp_path / "secret.tif")
    (folder / "loop").symlink_to("loop")
    os.mkfifo(folder / "pipe")
    with pytest.raises(ScanError) as caught:
        check_scan(folder)
    blamed = [problem for problem in caught.value.problems if problem.where == where]
    assert blamed, str(caught.value)
    assert words in " ".join(str(problem) for problem in blamed)


def test_all_problems_are_listed_at_once(tmp_path: Path) -> None:
    changes = {
        "/geometry/dso_mm": 900,
        "/geometry/detector/rows": -1,
        "/projections/kind": "x",
        "/volume/shape": 3,
        "/nonsense": 1,
        "/projections/files/0": "gone.tif",
    }
    text = problems(write_scan(tmp_path, changes=changes))
    for where in ("/geometry/dso_mm", "/geometry/detector/rows", "/projections/kind", "/volume/shape", "/nonsense"):
        assert where in text
    assert "gone.tif" in text


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (b"{", "is not JSON"),
        (b"", "is not JSON"),
        (b"[1]", "expected one object"),
        (b"\xff\xfe{\x00}\x00", "UTF-8"),
        (b'{"format": "a", "format": "b"}', "twice"),
        (b'{"name": ' + b"[" * 100_000 + b"]" * 100_000 + b"}", "deep"),
        (b'{"simulation": ' + b'{"a":' * 80 + b"1" + b"}" * 80 + b"}", "deep"),
        (b'{"name": ' + b"9" * 10_000 + b"}", "not usable JSON"),
        (b'{"name": 1e999}', "/name"),
        (b'{"name": "\\ud800"}', "is not JSON"),
        (b'{"name": "\xef\xbb\xbf', "is not JSON"),
        (b"\xef\xbb\xbf[1]", "expected one object"),
    ],
)
def test_text_that_is_not_a_scan(tmp_path: Path, text: bytes, words: str) -> None:
    folder = write_scan(tmp_path)
    (folder / "scan.json").write_bytes(text)
    assert words in problems(folder)


def test_a_long_document_is_refused_unread(tmp_path: Path) -> None:
    folder = write_scan(tmp_path)
    with (folder / "scan.json").open("r+b") as file:
        file.truncate(65 * 2**20)
    assert "more than the" in problems(folder)


def test_many_problems_are_cut_short(tmp_path: Path) -> None:
    text = problems(write_scan(tmp_path, changes={"/geometry/angles_deg": ["x"] * 500}))
    assert "more problems" in text and len(text.splitlines()) < 100


def test_missing_folders_and_files(tmp_path: Path) -> None:
    assert "does not exist" in problems(tmp_path / "nowhere")
    assert "the folder is empty" in problems(tmp_path)
    folder = write_scan(tmp_path / "scan")
    assert "is not a folder" in problems(folder / "scan.json")
    (folder / "scan.json").rename(tmp_path / "elsewhere.json")
    assert "scan.json is missing" in problems(folder)
    (folder / "scan.json").symlink_to(tmp_path / "elsewhere.json")
    assert "leads out of the scan folder" in problems(folder)


@pytest.mark.parametrize(
    ("key", "value", "words"),
    [
        ("u", [0, 0, 0], "u or v is zero"),
        ("u", [0, 0, -4.0], "u and v are parallel"),
        ("source", [-200.0, 5, 5], "the source lies in the detector's plane"),
        ("source", [1, 2], "expected 3 (x, y, z)"),
        ("source", [1e308, 0, 0], "expected a number"),
        ("ray", [1, 0, 0], "unknown key"),
        ("v", ..., "missing"),
    ],
)
def test_degenerate_frames(tmp_path: Path, key: str, value: Any, words: str) -> None:
    frames = read_scan(write_scan(tmp_path)).frames.to_json()
    if value is ...:
        del frames[0][key]
    else:
        frames[0][key] = value
    geometry = {"beam": "cone", "detector": {"rows": ROWS, "cols": COLS}, "frames": frames}
    text = problems(write_scan(tmp_path, changes={"/geometry": geometry}))
    assert "/geometry/frames/0" in text and words in text
    assert "/geometry/frames/1" not in text


def test_wrong_number_of_frames(tmp_path: Path) -> None:
    frames = read_scan(write_scan(tmp_path)).frames.to_json()[:-2]
    geometry = {"beam": "cone", "detector": {"rows": ROWS, "cols": COLS}, "frames": frames}
    assert "has 7 views, but the TIFF files hold 9 pages" in problems(
        write_scan(tmp_path, changes={"/geometry": geometry})
    )
