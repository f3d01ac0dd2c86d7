"""Good scan folders: what is read from them, and the facts and warnings that are told."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from splatcore.geometry import circular
from splatcore.grid import VolumeGrid, grid_from_view
from splatcore.projections import NeighbourFill
from splatcore.scan import check_scan, read_scan

from .scanfolder import COLS, ROWS, SCAN, VIEWS, plain_images, problems, write_scan, write_tiff


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
    counts[2, 3:5, 4:6] = 0  # a patch: a pixel alone would be taken from its neighbours
    changes = {"/projections/kind": "counts", "/projections/flat": ["flat.tif"]}
    folder = write_scan(tmp_path, counts, changes)
    write_tiff(folder / "flat.tif", np.full((ROWS, COLS), 1000, np.uint16))
    images = read_scan(folder).projections
    assert images[2, 3, 4] == pytest.approx(np.log(2000))
    assert np.count_nonzero(images) == 4
    assert any(text.startswith("4 pixels") and "0.0005" in text for text in check_scan(folder).warnings)


def test_negative_float_transmission_is_clamped(tmp_path: Path) -> None:
    images = np.exp(-plain_images())
    images[0, :2, :2] = -3
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
