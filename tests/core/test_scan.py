"""Scan folders: what is read from good ones, and what is said of bad ones."""

from __future__ import annotations

import json
import os
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from splatcore.errors import ScanError
from splatcore.geometry import circular
from splatcore.grid import VolumeGrid, grid_from_view
from splatcore.projections import NeighbourFill
from splatcore.scan import check_scan, read_scan
from splatcore.tiff import read_stack

from .scanfolder import COLS, ROWS, SCAN, VIEWS, plain_images, write_scan, write_tiff


def problems(folder: Path) -> str:
    """Everything a bad scan is blamed for; reading and checking must agree on it."""
    with pytest.raises(ScanError) as checked:
        check_scan(folder)
    with pytest.raises(ScanError) as read:
        read_scan(folder)
    assert str(read.value) == str(checked.value)
    return str(checked.value)


# --- good scans ---------------------------------------------------------------------------------------------


def test_plain_scan(tmp_path: Path) -> None:
    scan = read_scan(write_scan(tmp_path))
    np.testing.assert_array_equal(scan.projections, plain_images())
    assert scan.projections.dtype == np.float32
    assert scan.name == "small"
    expected = circular("cone", np.array(SCAN["geometry"]["angles_deg"]), 500, 700, ROWS, COLS, (2.0, 1.5))
    np.testing.assert_array_equal(scan.frames.source, expected.source)
    np.testing.assert_array_equal(scan.frames.u, expected.u)
    np.testing.assert_array_equal(scan.frames.v, expected.v)
    assert scan.volume == VolumeGrid((6, 7, 8), (1.0, 1.5, 2.0))
    assert (scan.time_s, scan.bad_pixels, scan.exposure, scan.tolerance, scan.simulation) == (None,) * 5


@pytest.mark.parametrize("dtype", ["uint8", "uint16", "uint32", "int16", "int32", "float16", "float32", "float64"])
@pytest.mark.parametrize("options", [{}, {"compression": "zlib"}, {"bigtiff": True, "byteorder": ">"}])
def test_every_pixel_type_is_scaled(tmp_path: Path, dtype: str, options: dict[str, Any]) -> None:
    images = (plain_images() * 100).astype(dtype)
    scan = read_scan(write_scan(tmp_path, images, {"/projections/scale": 0.01}, **options))
    np.testing.assert_allclose(scan.projections, images.astype(float) * 0.01, rtol=1e-6)


def test_tiles_strips_and_predictor(tmp_path: Path) -> None:
    images = np.random.default_rng(0).integers(0, 9999, (VIEWS, 40, 50), dtype=np.uint16)
    changes = {"/geometry/detector/rows": 40, "/geometry/detector/cols": 50}
    for name, options in {
        "tiles": {"tile": (16, 32)},
        "strips": {"rowsperstrip": 7},
        "predictor": {"compression": "zlib", "predictor": True, "tile": (16, 16)},
    }.items():
        scan = read_scan(write_scan(tmp_path / name, images, changes, **options))
        np.testing.assert_array_equal(scan.projections, images)


def test_one_file_per_view_in_the_order_given(tmp_path: Path) -> None:
    images = plain_images()
    names = [f"views/{k:03}.tif" for k in range(VIEWS)]
    folder = write_scan(tmp_path, changes={"/projections/files": [*names[5:], *names[:5]]})
    (folder / "views").mkdir()
    for name, image in zip(names, images, strict=True):
        write_tiff(folder / name, image)
    np.testing.assert_array_equal(read_scan(folder).projections, np.roll(images, -5, axis=0))


def test_files_are_concatenated(tmp_path: Path) -> None:
    images = plain_images()
    folder = write_scan(tmp_path, images[:4], {"/projections/files": ["projections.tif", "rest.tif"]})
    write_tiff(folder / "rest.tif", images[4:])
    np.testing.assert_array_equal(read_scan(folder).projections, images)


def test_transmission(tmp_path: Path) -> None:
    truth = plain_images()
    scan = read_scan(write_scan(tmp_path, np.exp(-truth), {"/projections/kind": "transmission"}))
    np.testing.assert_allclose(scan.projections, truth, atol=1e-6)


def test_counts_use_the_mean_flat_and_dark(tmp_path: Path) -> None:
    truth = plain_images()
    rng = np.random.default_rng(1)
    dark = rng.integers(90, 110, (3, ROWS, COLS)).astype(np.uint16)
    flat = rng.integers(50_000, 60_000, (4, ROWS, COLS)).astype(np.uint16)
    light = flat.mean(axis=0) - dark.mean(axis=0)
    counts = np.round(dark.mean(axis=0) + light * np.exp(-truth)).astype(np.uint16)
    changes = {
        "/projections/kind": "counts",
        "/projections/flat": ["flat_1.tif", "flat_2.tif"],
        "/projections/dark": ["dark.tif"],
        "/projections/scale": 2.0,
    }
    folder = write_scan(tmp_path, counts, changes)
    write_tiff(folder / "flat_1.tif", flat[:3])
    write_tiff(folder / "flat_2.tif", flat[3])
    write_tiff(folder / "dark.tif", dark)
    np.testing.assert_allclose(read_scan(folder).projections, truth, atol=2e-4)


def test_a_half_fan_without_a_full_turn_is_told(tmp_path: Path) -> None:
    """16 columns of 1.5 mm, so that 6 mm put the axis half way to the detector's end."""
    for name, offset, arc, told in (("a", 6.0, 240, True), ("b", 6.0, 360, False), ("c", 0.0, 240, False)):
        changes = {
            "/geometry/detector/offset_mm": [0.0, offset],
            "/geometry/angles_deg": [arc / VIEWS * k for k in range(VIEWS)],
        }
        facts = check_scan(write_scan(tmp_path / name, changes=changes))
        assert any("half fan" in text for text in facts.warnings) == told


def test_a_detector_beside_the_object_is_told(tmp_path: Path) -> None:
    facts = check_scan(write_scan(tmp_path, changes={"/geometry/detector/offset_mm": [0.0, 40.0]}))
    assert any("falls off the detector" in text for text in facts.warnings)


@pytest.mark.parametrize("kind", ["counts", "transmission"])
def test_the_exposure_of_a_view_is_divided_out(tmp_path: Path, kind: str) -> None:
    truth = plain_images()
    exposure = np.linspace(80.0, 120.0, VIEWS)  # as a tube logs it; the flat was taken at their mean
    light = 50_000.0 if kind == "counts" else 1.0
    images = 100.0 * (kind == "counts") + light * (exposure / 100)[:, None, None] * np.exp(-truth)
    changes = {"/projections/kind": kind, "/projections/exposure": exposure.tolist()}
    if kind == "counts":
        changes |= {"/projections/flat": ["flat.tif"], "/projections/dark": ["dark.tif"]}
    folder = write_scan(tmp_path, images.astype(np.float32), changes)
    write_tiff(folder / "flat.tif", np.full((ROWS, COLS), light + 100, np.float32))
    write_tiff(folder / "dark.tif", np.full((ROWS, COLS), 100, np.float32))
    np.testing.assert_allclose(read_scan(folder).projections, truth, atol=1e-5)


def test_line_integrals_are_taken_to_be_corrected_for_exposure(tmp_path: Path) -> None:
    folder = write_scan(tmp_path, changes={"/projections/exposure": [1.0 + k / 10 for k in range(VIEWS)]})
    np.testing.assert_array_equal(read_scan(folder).projections, plain_images())
    assert any("taken to be corrected" in text for text in check_scan(folder).warnings)


def test_no_light_is_clamped_to_half_a_count_and_told(tmp_path: Path) -> None:
    counts = np.full((VIEWS, ROWS, COLS), 1000, np.uint16)
    counts[2, 3, 4:6] = 0
    changes = {"/projections/kind": "counts", "/projections/flat": ["flat.tif"]}
    folder = write_scan(tmp_path, counts, changes)
    write_tiff(folder / "flat.tif", np.full((ROWS, COLS), 1000, np.uint16))
    images = read_scan(folder).projections
    assert images[2, 3, 4] == pytest.approx(np.log(2000))
    assert np.count_nonzero(images) == 2
    assert any(text.startswith("2 pixels") and "0.0005" in text for text in check_scan(folder).warnings)


def test_negative_float_transmission_is_clamped(tmp_path: Path) -> None:
    images = np.exp(-plain_images())
    images[0, 0, 0] = -3
    scan = read_scan(write_scan(tmp_path, images, {"/projections/kind": "transmission"}))
    assert scan.projections[0, 0, 0] == pytest.approx(16 * np.log(2))


def test_bad_pixels_are_filled_and_kept_as_a_mask(tmp_path: Path) -> None:
    r, c = np.mgrid[:ROWS, :COLS]
    ramp = np.broadcast_to(2.0 * r + 3 * c, (VIEWS, ROWS, COLS)).astype(np.float32).copy()
    mask = np.zeros((ROWS, COLS), np.uint8)
    mask[5, 6] = 255
    mask[0, 0] = 1
    images = ramp.copy()
    images[:, 5, 6], images[:, 0, 0] = np.nan, 1e30  # dead pixels may hold anything
    folder = write_scan(tmp_path, images, {"/projections/bad_pixels": "mask.tif"})
    write_tiff(folder / "mask.tif", mask)
    scan = read_scan(folder)
    np.testing.assert_array_equal(scan.bad_pixels, mask > 0)
    np.testing.assert_allclose(scan.projections[:, 5, 6], ramp[:, 5, 6], rtol=1e-6)  # the mean of 8 on a ramp
    np.testing.assert_allclose(scan.projections[:, 0, 0], (2 + 3 + 5) / 3, rtol=1e-6)
    assert check_scan(folder).bad_pixels == 2


@given(st.integers(0, 2**32 - 1), st.floats(0.0, 0.95))
@settings(max_examples=30, deadline=None)
def test_filling_keeps_good_pixels_and_stays_in_their_range(seed: int, share: float) -> None:
    rng = np.random.default_rng(seed)
    mask = rng.random((7, 9)) < share
    mask[3, 3] = False
    image = rng.random((7, 9), np.float32)
    dirty = np.where(mask, np.float32(99), image)
    filled = NeighbourFill(mask)(dirty.copy())
    np.testing.assert_array_equal(filled[~mask], image[~mask])
    assert filled.min() >= image[~mask].min() - 1e-6 and filled.max() <= image[~mask].max() + 1e-6


def test_frames_instead_of_angles(tmp_path: Path) -> None:
    plain = read_scan(write_scan(tmp_path / "angles"))
    frames = plain.frames.to_json()
    frames[3]["source"] = [500.0, 1.0, 2.0]
    geometry = {"beam": "cone", "detector": {"rows": ROWS, "cols": COLS}, "frames": frames}
    scan = read_scan(write_scan(tmp_path / "frames", changes={"/geometry": geometry}))
    assert scan.frames.to_json() == frames
    # dso, dsd, pixel and offset inform only: nonsense there is no problem, and angles may stay beside.
    detector = {"rows": ROWS, "cols": COLS, "pixel_mm": [9, 9], "offset_mm": [1, 1]}
    geometry |= {"dso_mm": 900.0, "dsd_mm": 100.0, "detector": detector, "angles_deg": [0.0]}
    scan = read_scan(write_scan(tmp_path / "informed", changes={"/geometry": geometry}))
    assert scan.frames.to_json() == frames


def test_parallel_beam(tmp_path: Path) -> None:
    geometry = {**SCAN["geometry"], "beam": "parallel"}
    del geometry["dso_mm"], geometry["dsd_mm"]
    scan = read_scan(write_scan(tmp_path / "angles", changes={"/geometry": geometry}))
    assert scan.frames.beam == "parallel"
    np.testing.assert_allclose(scan.frames.source[0], [-1, 0, 0], atol=1e-12)
    frames = scan.frames.to_json()
    frames[0]["ray"] = [-7.0, 0.0, 0.0]
    given_frames = {"beam": "parallel", "detector": {"rows": ROWS, "cols": COLS}, "frames": frames}
    again = read_scan(write_scan(tmp_path / "rays", changes={"/geometry": given_frames}))
    np.testing.assert_allclose(again.frames.source, scan.frames.source, atol=1e-12)


def test_everything_optional(tmp_path: Path) -> None:
    changes = {
        "/time_s": [float(k) for k in range(VIEWS)],
        "/projections/exposure": [1.0] * VIEWS,
        "/tolerance": {"rotation_deg": 0.1},
        "/simulation": {"volume_file": "nowhere.tif", "anything": [1, {"goes": None}]},
        "/volume/center_mm": [1.0, 2.0, 3.0],
        "/name": ...,
    }
    scan = read_scan(write_scan(tmp_path / "folder name", changes=changes))
    assert scan.name == "folder name"
    assert scan.time_s == tuple(range(VIEWS)) and scan.exposure == (1.0,) * VIEWS
    assert scan.tolerance is not None
    assert (scan.tolerance.rotation_deg, scan.tolerance.translation_mm) == (0.1, None)
    assert scan.simulation == changes["/simulation"]
    x, y, z = scan.volume.axes_mm()
    assert (x[0], y[0], z[0]) == (1 - 8 + 1.0, 2 - 5.25 + 0.75, 3 - 3 + 0.5)
    assert (len(x), len(y), len(z)) == (8, 7, 6)
    np.testing.assert_array_equal(scan.volume.half_extent_mm(), [8, 5.25, 3])
    np.testing.assert_array_equal(scan.volume.centers_mm()[2, 3, 4], [x[4], y[3], z[2]])


def test_a_byte_order_mark_is_forgiven(tmp_path: Path) -> None:
    folder = write_scan(tmp_path)
    text = (folder / "scan.json").read_bytes()
    (folder / "scan.json").write_bytes(b"\xef\xbb\xbf" + text)
    assert read_scan(folder).name == "small"


def test_a_link_inside_the_folder_is_followed(tmp_path: Path) -> None:
    folder = write_scan(tmp_path, changes={"/projections/files": ["link.tif"]})
    (folder / "link.tif").symlink_to("projections.tif")
    assert len(read_scan(folder).projections) == VIEWS


def test_volume_from_the_field_of_view(tmp_path: Path) -> None:
    frames = circular("cone", np.arange(0.0, 360, 10), 500, 700, 200, 100, (1.4, 1.4))
    grid = grid_from_view(frames)
    assert grid.voxel_mm == pytest.approx((1.0, 1.0, 1.0))
    assert grid.shape == (200, 99, 99)  # 2 * 500 sin(atan(70 / 700)) = 99.5 across
    assert grid.center_mm == pytest.approx((0, 0, 0))
    shifted = grid_from_view(circular("cone", np.arange(0.0, 360, 10), 500, 700, 200, 100, (1.4, 1.4), (14.0, 0.0)))
    assert shifted.center_mm == pytest.approx((0, 0, -10.0)), "v points down: a detector moved by +v sees lower z"
    half_fan = grid_from_view(circular("cone", np.arange(0.0, 360, 10), 500, 700, 200, 100, (1.4, 1.4), (0.0, 42.0)))
    assert half_fan.shape[1] == int(1000 * np.sin(np.arctan(112 / 700)))
    parallel = grid_from_view(circular("parallel", np.arange(0.0, 180, 10), 0, 0, 30, 40, (0.5, 0.5)))
    assert (parallel.shape, parallel.voxel_mm) == ((30, 40, 40), (0.5, 0.5, 0.5))
    huge = grid_from_view(circular("parallel", np.arange(0.0, 180, 10), 0, 0, 4000, 4000, (0.1, 0.1)))
    assert huge.voxels <= 512**3 and huge.shape[0] * huge.voxel_mm[0] == pytest.approx(400, rel=0.01)
    scan = read_scan(write_scan(tmp_path, changes={"/volume": ...}))
    assert scan.volume == grid_from_view(scan.frames)


@pytest.mark.parametrize(
    ("source", "words"),
    [((0, 0, 0), "does not lie before the source"), ((-10, 3, 0), "does not lie before"), ((1, 0, 99), "along the ro")],
)
def test_a_volume_that_cannot_be_derived(tmp_path: Path, source: tuple[float, ...], words: str) -> None:
    frame = {"source": source, "detector_center": [-200, 0, 0], "u": [0, 1, 0], "v": [0, 0, -1]}
    if words.startswith("along"):
        frame |= {"detector_center": [0, 0, -99], "v": [1, 0, 0]}
    geometry = {"beam": "cone", "detector": {"rows": ROWS, "cols": COLS}, "frames": [frame] * VIEWS}
    folder = write_scan(tmp_path, changes={"/geometry": geometry, "/volume": ...})
    assert words in problems(folder)
    (folder / "scan.json").write_text((folder / "scan.json").read_text()[:-1] + ', "volume": ' + BOX + "}")
    if source != (0, 0, 0):
        assert check_scan(folder).volume_shape == (2, 2, 2)


BOX = '{"shape": [2, 2, 2], "voxel_mm": [0.1, 0.1, 0.1]}'


def test_pointers_are_fit_for_a_terminal(tmp_path: Path) -> None:
    text = problems(write_scan(tmp_path, changes={"/\x1b[31mred": 1, "/" + "k" * 500: 2}))
    assert text.isascii() or "…" in text
    assert "\x1b" not in text and "\\x1b[31mred" in text and "k" * 100 not in text


# --- facts and warnings -------------------------------------------------------------------------------------


def test_facts(tmp_path: Path) -> None:
    facts = check_scan(write_scan(tmp_path))
    assert (facts.views, facts.rows, facts.cols, facts.dtype) == (VIEWS, ROWS, COLS, "float32")
    assert (facts.arc_deg, facts.max_gap_deg) == (360.0, 40.0)
    assert facts.line_integral is not None
    assert facts.line_integral["max"] == pytest.approx(float(plain_images().max()))
    assert facts.air_level == 0.0
    assert facts.bytes == (tmp_path / "projections.tif").stat().st_size
    assert facts.warnings == ["only 9 views"]
    assert check_scan(tmp_path, pixels=False).line_integral is None


@pytest.mark.parametrize(
    ("angles", "arc", "gap"),
    [
        ([0, 20, 40, 60, 80, 100, 120, 140, 160], 180, 20),
        ([0, 20, 40, 60, 100, 120, 140, 160, 180], 200, 40),
        ([360, -20, 700, 60, 80, 460, 120, 140, 160], 200, 60),
        ([k * 222.4922359 for k in range(VIEWS)], 360, 52.546),
    ],
)  # fmt: skip
def test_arc_and_gap(tmp_path: Path, angles: list[float], arc: float, gap: float) -> None:
    facts = check_scan(write_scan(tmp_path, changes={"/geometry/angles_deg": angles}))
    assert (facts.arc_deg, facts.max_gap_deg) == pytest.approx((arc, gap), abs=0.1)


@pytest.mark.parametrize(
    ("images", "kind", "text"),
    [
        ((1000 * np.exp(-plain_images())).astype(np.uint16), "line_integrals", "look like raw counts"),
        (30 * plain_images(), "line_integrals", "values > 20"),
        (np.exp(-plain_images()), "line_integrals", "look like a transmission"),
        (3 * np.exp(-plain_images()), "transmission", "brighter than the open beam"),
        (np.where(np.arange(VIEWS)[:, None, None] == 4, 0, plain_images()), "line_integrals", "view 4: all pixels"),
        (-plain_images() - 0.1, "line_integrals", "no line integral is above zero (at most -0.1)"),
        (np.roll(plain_images(), 7, axis=2), "line_integrals", "right (100% of views)"),
        (np.roll(plain_images(), -4, axis=1), "line_integrals", "cut off at the image edge: top (100% of views)"),
    ],
)
def test_warnings(tmp_path: Path, images: np.ndarray, kind: str, text: str) -> None:
    folder = write_scan(tmp_path, images, {"/projections/kind": kind})
    assert [warning for warning in check_scan(folder).warnings if text in warning]


def test_all_zero_scan_has_facts(tmp_path: Path) -> None:
    facts = check_scan(write_scan(tmp_path, 0 * plain_images()))
    assert facts.air_level is None and "all pixels are zero" in " ".join(facts.warnings)


# --- scan.json that is wrong ----------------------------------------------------------------------------------

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


# --- TIFF files that are wrong ----------------------------------------------------------------------------------


def test_transposed_images_get_a_hint(tmp_path: Path) -> None:
    text = problems(write_scan(tmp_path, np.swapaxes(plain_images(), 1, 2)))
    assert "swap rows and cols" in text


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_pixels_that_are_not_finite(tmp_path: Path, value: float) -> None:
    images = plain_images()
    images[2, 1, 1:4] = value
    images[7, 0, 0] = value
    text = problems(write_scan(tmp_path, images))
    assert "projections.tif, page 3 of 9: 3 pixels" in text
    assert "projections.tif, page 8 of 9: 1 pixels" in text


def test_a_flat_next_to_nothing_is_caught(tmp_path: Path) -> None:
    changes = {"/projections/kind": "counts", "/projections/flat": ["flat.tif"]}
    folder = write_scan(tmp_path, 1 + plain_images(), changes)
    flat = np.ones((ROWS, COLS))
    flat[3, 4] = 1e-300
    write_tiff(folder / "flat.tif", flat)
    assert "page 1 of 9: 1 pixels" in problems(folder)


def test_signalling_nans_are_only_nans(tmp_path: Path) -> None:
    images = plain_images().astype("float64")
    images.view("u8")[0, 0, 0] = 0x7FF0000000000001
    assert "page 1 of 9: 1 pixels" in problems(write_scan(tmp_path, images))


@pytest.mark.parametrize(
    ("offset", "raw", "words"),
    [
        (0, b"MMXX", "is not a TIFF file"),
        (4, b"\xff\xff\xff\xff", "is cut short: the header of page 1"),
        (8, b"\xff\xff", "is cut short: the header of page 1"),
    ],
)
def test_headers_that_lead_nowhere(tmp_path: Path, offset: int, raw: bytes, words: str) -> None:
    folder = write_scan(tmp_path)
    with (folder / "projections.tif").open("r+b") as file:
        file.seek(offset)
        file.write(raw)
    assert words in problems(folder)


def test_doubles_too_large_for_floats(tmp_path: Path) -> None:
    images = plain_images("float64")
    images[0, 0, 0] = 1e300
    assert "page 1 of 9: 1 pixels" in problems(write_scan(tmp_path, images))


@pytest.mark.parametrize("options", [{}, {"bigtiff": True}, {"compression": "zlib"}, {"byteorder": ">"}])
def test_cut_files_never_pass(tmp_path: Path, options: dict[str, Any]) -> None:
    images = np.random.default_rng(0).random((VIEWS, ROWS, COLS), np.float32)
    folder = write_scan(tmp_path, images, **options)
    whole = (folder / "projections.tif").read_bytes()
    for length in [0, 3, 7, 12, 100, *range(200, len(whole) - 1, 397)]:
        (folder / "projections.tif").write_bytes(whole[:length])
        assert "projections.tif" in problems(folder)


def test_a_cut_file_names_file_and_page(tmp_path: Path) -> None:
    folder = tmp_path
    with tifffile.TiffWriter(write_scan(folder) / "projections.tif") as file:
        for image in plain_images():
            file.write(image, photometric="minisblack", contiguous=False)
    path = folder / "projections.tif"
    path.write_bytes(path.read_bytes()[:5000])
    text = problems(folder)
    assert "projections.tif, page" in text and "the file at byte 5000" in text


@given(st.data())
@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_damaged_headers_end_in_scan_error_or_a_scan(tmp_path: Path, data: st.DataObject) -> None:
    folder = write_scan(tmp_path, compression="zlib")
    raw = bytearray((folder / "projections.tif").read_bytes())
    for _ in range(data.draw(st.integers(1, 4))):
        raw[data.draw(st.integers(0, min(len(raw), 1200) - 1))] = data.draw(st.integers(0, 255))
    (folder / "projections.tif").write_bytes(raw)
    try:
        scan = read_scan(folder)
    except ScanError:
        return
    assert scan.projections.shape == (VIEWS, ROWS, COLS) and np.isfinite(scan.projections).all()


def test_pages_that_differ(tmp_path: Path) -> None:
    folder = write_scan(tmp_path)
    with tifffile.TiffWriter(folder / "projections.tif") as file:
        for k, image in enumerate(plain_images()):
            file.write(image[:, : COLS - (k == 6)], photometric="minisblack")
    text = problems(folder)
    assert "projections.tif, page 7: is 12 x 15 float32, but page 1 is 12 x 16 float32" in text


def test_files_whose_types_differ(tmp_path: Path) -> None:
    images = plain_images()
    folder = write_scan(tmp_path, images[:5], {"/projections/files": ["projections.tif", "b.tif"]})
    write_tiff(folder / "b.tif", images[5:].astype(np.uint8))
    assert "b.tif: holds uint8 pixels, but projections.tif holds float32" in problems(folder)


@pytest.mark.parametrize("dtype", ["int8", "complex64", "uint64", "bool"])
def test_pixel_types_not_taken(tmp_path: Path, dtype: str) -> None:
    folder = write_scan(tmp_path)
    tifffile.imwrite(folder / "projections.tif", plain_images(dtype), photometric="minisblack")
    assert "page 1 of 9: holds" in problems(folder)


def test_colour_is_refused(tmp_path: Path) -> None:
    folder = write_scan(tmp_path)
    tifffile.imwrite(folder / "projections.tif", np.zeros((VIEWS, ROWS, COLS, 3), np.uint8), photometric="rgb")
    assert "grayscale" in problems(folder)


def test_compression_without_a_decoder_is_refused(tmp_path: Path) -> None:
    folder = write_scan(tmp_path)
    path = folder / "projections.tif"
    raw = bytearray(path.read_bytes())
    at = raw.index(struct.pack("<HHI", 259, 3, 1))  # the Compression tag of the first page
    raw[at + 8 : at + 10] = struct.pack("<H", 5)
    path.write_bytes(raw)
    assert "page 1 of 9: is compressed with LZW" in problems(folder)


@pytest.mark.parametrize("options", [{}, {"compression": "zlib"}])
def test_a_small_file_that_claims_to_be_huge_is_not_decoded(tmp_path: Path, options: dict[str, Any]) -> None:
    changes = {"/geometry/detector/rows": 30_000, "/geometry/detector/cols": 30_000}
    folder = write_scan(tmp_path, changes=changes, **options)
    path = folder / "projections.tif"
    raw = bytearray(path.read_bytes())
    for tag in (256, 257, 278):  # width, length, rows per strip
        at = raw.index(struct.pack("<H", tag), 8)
        raw[at + 2 : at + 12] = struct.pack("<HII", 4, 1, 30_000)
    path.write_bytes(raw)
    assert "claims 3600000000 bytes of pixels" in problems(folder)


def test_a_page_that_stores_less_than_it_claims_is_refused(tmp_path: Path) -> None:
    """It would otherwise read as zeros from there on."""
    folder = write_scan(tmp_path)
    path = folder / "projections.tif"
    raw = bytearray(path.read_bytes())
    at = raw.index(struct.pack("<HHI", 279, 4, 1))  # StripByteCounts of the first page
    raw[at + 8 : at + 12] = struct.pack("<I", ROWS * COLS * 2)
    path.write_bytes(raw)
    assert "page 1 of 9: claims 768 bytes of pixels and stores 384" in problems(folder)


def test_pages_in_a_circle(tmp_path: Path) -> None:
    folder = write_scan(tmp_path)
    path = folder / "projections.tif"
    raw = bytearray(path.read_bytes())
    first = struct.unpack("<I", raw[4:8])[0]
    tags = struct.unpack("<H", raw[first : first + 2])[0]
    raw[first + 2 + 12 * tags : first + 6 + 12 * tags] = struct.pack("<I", first)
    path.write_bytes(raw)
    assert "run in a circle" in problems(folder)


def test_ome_metadata_cannot_name_other_files(tmp_path: Path) -> None:
    secret = tmp_path / "secret.tif"
    write_tiff(secret, np.full((VIEWS, ROWS, COLS), 7, np.float32))
    folder = write_scan(tmp_path / "scan")
    xml = (
        '<?xml version="1.0"?><OME xmlns="http://www.openmicroscopy.org/Schemas/OME/2016-06"><Image ID="Image:0">'
        f'<Pixels ID="Pixels:0" DimensionOrder="XYZCT" Type="float" SizeX="{COLS}" SizeY="{ROWS}" SizeZ="{VIEWS}" '
        'SizeC="1" SizeT="1"><TiffData IFD="0" FirstZ="0" PlaneCount="9"><UUID FileName="../secret.tif">urn:uuid:1'
        "</UUID></TiffData></Pixels></Image></OME>"
    )
    write_tiff(folder / "projections.tif", plain_images(), description=xml, metadata=None)
    np.testing.assert_array_equal(read_scan(folder).projections, plain_images())


def test_masks_and_flats_that_do_not_fit(tmp_path: Path) -> None:
    changes = {
        "/projections/kind": "counts",
        "/projections/flat": ["flat.tif"],
        "/projections/dark": ["dark.tif"],
        "/projections/bad_pixels": "mask.tif",
    }
    folder = write_scan(tmp_path, changes=changes)
    write_tiff(folder / "flat.tif", np.ones((ROWS, COLS + 1), np.float32))
    write_tiff(folder / "dark.tif", np.zeros((ROWS, COLS), np.float32))
    write_tiff(folder / "mask.tif", np.zeros((2, ROWS, COLS), np.uint8))
    text = problems(folder)
    assert "flat.tif: holds pages of 12 rows x 17 columns" in text and "mask.tif: has 2 pages, expected one" in text
    write_tiff(folder / "mask.tif", np.ones((ROWS, COLS), np.uint8))
    write_tiff(folder / "flat.tif", np.ones((ROWS, COLS), np.float32))
    assert "mask.tif: leaves no good pixel" in problems(folder)
    write_tiff(folder / "mask.tif", np.zeros((ROWS, COLS), np.uint8))
    write_tiff(folder / "dark.tif", np.full((ROWS, COLS), 2, np.float32))
    assert "flat.tif: is not brighter than the dark image in 192 of 192 pixels" in problems(folder)


def test_an_imagej_stack_of_one_page_gets_a_hint(tmp_path: Path) -> None:
    folder = write_scan(tmp_path)
    with tifffile.TiffWriter(folder / "projections.tif") as file:
        file.write(plain_images(), photometric="minisblack", truncate=True)
    assert "save it as a multi-page BigTIFF" in problems(folder)


def test_read_stack(tmp_path: Path) -> None:
    write_tiff(tmp_path / "volume.tif", plain_images())
    np.testing.assert_array_equal(read_stack(tmp_path / "volume.tif"), plain_images())
    (tmp_path / "volume.tif").write_bytes(b"II*\0 not a volume")
    with pytest.raises(ScanError):
        read_stack(tmp_path / "volume.tif")


def test_problems_serialise(tmp_path: Path) -> None:
    with pytest.raises(ScanError) as caught:
        check_scan(write_scan(tmp_path, changes={"/name": "\ud800"}))
    json.dumps([problem.to_json() for problem in caught.value.problems]).encode()
