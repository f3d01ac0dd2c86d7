"""Images of scans that are wrong, hostile or cut: what they are blamed for."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from splatcore.errors import ScanError
from splatcore.scan import check_scan, read_scan
from splatcore.tiff import read_stack

from .scanfolder import COLS, ROWS, VIEWS, plain_images, problems, write_scan, write_tiff


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
