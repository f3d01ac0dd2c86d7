"""Scans that attack: what test_hostile_scans.py sends to a real server, and bench/load times the refusal of."""

from __future__ import annotations

import io
import json
import struct
import zlib
from collections.abc import Callable
from typing import Any

import numpy as np
import tifffile

from .stack import SCAN, scan_files

ROWS = COLS = 16
VIEWS = 12
STRIP_OFFSETS, STRIP_BYTES, SUB_IFDS, DESCRIPTION = 273, 279, 330, 270
Files = dict[str, bytes]


def ifd(tags: dict[int, tuple[int, int, int]], following: int) -> bytes:
    """A directory of classic TIFF: tag -> (type, count, value or offset)."""
    entries = b"".join(struct.pack("<HHII", tag, *tags[tag]) for tag in sorted(tags))
    return struct.pack("<H", len(tags)) + entries + struct.pack("<I", following)


def page_tags(
    rows: int, cols: int, bits: int, compression: int, at: int, stored: int
) -> dict[int, tuple[int, int, int]]:
    """One strip of unsigned integers."""
    return {
        256: (4, 1, cols), 257: (4, 1, rows), 258: (3, 1, bits), 259: (3, 1, compression), 262: (3, 1, 1),
        STRIP_OFFSETS: (4, 1, at), 277: (3, 1, 1), 278: (4, 1, rows), STRIP_BYTES: (4, 1, stored),
    }  # fmt: skip


def one_page(
    rows: int, cols: int, data: bytes, bits: int = 8, compression: int = 1, **more: tuple[int, int, int]
) -> bytes:
    tags = page_tags(rows, cols, bits, compression, 8, len(data)) | {int(tag[1:]): value for tag, value in more.items()}
    return struct.pack("<2sHI", b"II", 42, 8 + len(data)) + data + ifd(tags, 0)


def many_pages(count: int, shared: Callable[[int], dict[int, tuple[int, int, int]]], head: bytes) -> bytes:
    """Pages whose directories differ in nothing but their place; `head` lies at byte 8."""
    start = 8 + len(head)
    size = len(ifd(shared(0), 0))
    chain = b"".join(ifd(shared(n), start + (n + 1) * size if n + 1 < count else 0) for n in range(count))
    return struct.pack("<2sHI", b"II", 42, start) + head + chain


def bare_directories(count: int) -> bytes:
    """A chain of directories with one tag each, 18 bytes."""
    each = np.zeros(
        count,
        np.dtype([("n", "<u2"), ("tag", "<u2"), ("type", "<u2"), ("items", "<u4"), ("v", "<u4"), ("next", "<u4")]),
    )
    each["n"], each["tag"], each["type"], each["items"], each["v"] = 1, 256, 4, 1, 16
    each["next"][:-1] = 8 + 18 * np.arange(1, count)
    return struct.pack("<2sHI", b"II", 42, 8) + each.tobytes()


def tiff(pixels: np.ndarray, **options: Any) -> bytes:
    out = io.BytesIO()
    tifffile.imwrite(out, pixels, **{"photometric": "minisblack"} | options)
    return out.getvalue()


def with_tiff(data: bytes, change: Callable[[dict[str, Any]], Any] | None = None) -> Files:
    return {**scan_files(change), "projections.tif": data}


def with_json(text: str | bytes) -> Files:
    return {**scan_files(), "scan.json": text if isinstance(text, bytes) else text.encode()}


def with_value(pointer: str, text: str) -> Files:
    """`text` in place of a value, as JSON that no library would write."""
    scan = json.loads(json.dumps(SCAN))
    *path, last = pointer.strip("/").split("/")
    target = scan
    for key in path:
        target = target[key]
    target[last] = "@@"
    return with_json(json.dumps(scan).replace('"@@"', text))


def frames_of(text: str) -> Files:
    """A scan whose views have frames of their own, and these."""
    scan = json.loads(json.dumps(SCAN))
    scan["geometry"] = {key: scan["geometry"][key] for key in ("beam", "detector")} | {"frames": "@@"}
    return with_json(json.dumps(scan).replace('"@@"', f"[{text}]"))


def detector(rows: int, cols: int, views: int = VIEWS) -> Callable[[dict[str, Any]], None]:
    def change(scan: dict[str, Any]) -> None:
        scan["geometry"]["detector"] |= {"rows": rows, "cols": cols, "pixel_mm": [1e-3, 1e-3]}
        scan["geometry"]["angles_deg"] = [1.0 * view for view in range(views)]

    return change


def names(*files: Any) -> Files:
    return scan_files(lambda scan: scan["projections"].update(files=list(files)))


def good_pixels(dtype: str = "float32") -> np.ndarray:
    return np.ones((VIEWS, ROWS, COLS), dtype)


def deflate_bomb() -> bytes:
    """A page of 1 KiB whose data inflate to what would fill the machine."""
    squeeze = zlib.compressobj(9)
    data = b"".join(squeeze.compress(bytes(2**20)) for _ in range(400)) + squeeze.flush()
    return one_page(2048, 2048, data, compression=8)


def zero_bomb(side: int) -> bytes:
    """An honest page of zeros, packed a thousand to one."""
    squeeze = zlib.compressobj(9)
    data = b"".join(squeeze.compress(bytes(side)) for _ in range(side)) + squeeze.flush()
    return one_page(side, side, data, compression=8)


def circle() -> bytes:
    raw = bytearray(tiff(good_pixels()))
    first = struct.unpack("<I", raw[4:8])[0]
    tags = struct.unpack("<H", raw[first : first + 2])[0]
    raw[first + 2 + 12 * tags : first + 6 + 12 * tags] = struct.pack("<I", first)
    return bytes(raw)


def three_bad_files() -> Files:
    files = names("projections.tif", "second.tif", "third.tif")
    return {**files, "projections.tif": circle(), "second.tif": b"PK", "third.tif": tiff(good_pixels("complex64"))}


def nan_pixels(value: float) -> Files:
    pixels = good_pixels()
    pixels[3, 2, 1] = value
    return scan_files(pixels=pixels)


def large_tags() -> bytes:
    """Every page has the same long list of strips read anew."""
    strips = 200_000
    return many_pages(
        2000,
        lambda _: page_tags(ROWS, COLS, 8, 1, 8, 256)
        | {STRIP_OFFSETS: (4, strips, 8), STRIP_BYTES: (4, strips, 8)},
        bytes(4 * strips),
    )  # fmt: skip


def shared_pixels() -> Files:
    """Three thousand views of 4 MiB that are all the same bytes of the file."""
    side, views = 2048, 3000
    data = many_pages(views, lambda _: page_tags(side, side, 8, 1, 8, side * side), b"\x07" * side * side)
    return with_tiff(data, detector(side, side, views))


# What is refused: the scan, and words of each complaint that there must be.
REFUSED: dict[str, tuple[Callable[[], Files], tuple[str, ...]]] = {
    "a page of a terabyte": (lambda: with_tiff(one_page(2**20, 2**20, b"x" * 1000)), ("projections.tif, page 1",)),
    "a page of four gigabytes": (lambda: with_tiff(one_page(32768, 32768, b"x" * 1000, bits=32)), ("claims",)),
    "4294967295 rows": (lambda: with_tiff(one_page(2**32 - 1, 2**32 - 1, b"x" * 1000)), ("projections.tif",)),
    "no rows": (lambda: with_tiff(one_page(0, 16, b"x" * 1000)), ("projections.tif, page 1",)),
    "deflate bomb": (lambda: with_tiff(deflate_bomb(), detector(2048, 2048, 1)), ("inflate to more than",)),
    "deflate bomb of honest size": (lambda: with_tiff(zero_bomb(32768), detector(32768, 32768, 1)), ("200 to 1",)),
    "LZW bomb": (lambda: with_tiff(one_page(16, 16, b"\x80\x0b\x60" * 999, compression=5)), ("LZW",)),
    "pages that share their pixels": (shared_pixels, ("may not share",)),
    "pages in a circle": (lambda: with_tiff(circle()), ("run in a circle",)),
    "a page that follows itself": (
        lambda: with_tiff(struct.pack("<2sHI", b"II", 42, 8) + ifd({256: (4, 1, 1)}, 8)), ("circle",),
    ),
    "a million pages": (lambda: with_tiff(bare_directories(10**6)), ("more than 1000 pages",)),
    "far more pages than views": (lambda: with_tiff(bare_directories(90_000)), ("more than 1000 pages",)),
    "directories that share large lists": (lambda: with_tiff(large_tags()), ("claim",)),
    "a list of strips without end": (
        lambda: with_tiff(one_page(16, 16, bytes(9 * 2**20), t273=(4, 2**21, 8), t279=(4, 2**21, 8))), ("items",),
    ),
    "a tag that claims 4 GiB": (lambda: with_tiff(one_page(16, 16, b"x" * 999, t273=(4, 2**30, 8))), ("items",)),
    "the header and nothing": (lambda: with_tiff(b"II*\0\x08\0\0\0"), ("cut short",)),
    "complex pixels": (lambda: with_tiff(tiff(good_pixels("complex64"))), ("complex64",)),
    "pixels of one bit": (lambda: with_tiff(tiff(good_pixels("bool"))), ("projections.tif, page 1",)),
    "colour": (lambda: with_tiff(tiff(np.ones((VIEWS, ROWS, COLS, 3), "uint8"), photometric="rgb")), ("3 samples",)),
    "not a number": (lambda: nan_pixels(np.nan), ("projections.tif",)),
    "infinite": (lambda: nan_pixels(np.inf), ("projections.tif",)),
    "minus infinite": (lambda: nan_pixels(-np.inf), ("projections.tif",)),
    "absurd": (lambda: nan_pixels(3e38), ("projections.tif",)),
    "no views": (lambda: scan_files(lambda scan: scan["geometry"].update(angles_deg=[])), ("/geometry/angles_deg",)),
    "no files": (lambda: names(), ("/projections/files",)),
    "several bad files": (
        three_bad_files, ("projections.tif: its page", "second.tif: is not a TIFF", "third.tif, page 1"),
    ),
    "a file above": (lambda: names("../../../splatct.db"), ("not a plain relative path",)),
    "a file by its whole path": (lambda: names("/etc/passwd"), ("not a plain relative path",)),
    "a file by a backslash": (lambda: names("..\\projections.tif"), ("not a plain relative path",)),
    "a stream of a file": (lambda: names("projections.tif:hidden"), ("not a plain relative path",)),
    "a name with NUL": (lambda: names("projections.tif\0.png"), ("not a plain relative path",)),
    "a name that turns around": (lambda: names("proj\u202eections.tif"), ("not a plain relative path",)),
    "half a character": (lambda: names("\ud800.tif"), ("two escapes",)),
    "the folder itself": (lambda: names("."), ("not a regular file",)),
    "scan.json as pixels": (lambda: names("scan.json"), ("is not a TIFF",)),
    "one file twice": (lambda: names("projections.tif", "./projections.tif"), ("same file",)),
    "a name in another normal form": (lambda: names("projectio\u0303ns.tif"), ("does not exist",)),
    "a path without end": (lambda: names("a/" * 100_000 + "b.tif"), ("200005 characters",)),
    "a number as name": (lambda: names(1e308), ("expected a file name",)),
    "50,000 names of nothing": (lambda: names(*(f"{'v' * 200}{n}.tif" for n in range(50_000))), ("at least 1 more",)),
    "1e308": (lambda: with_value("/geometry/dso_mm", "1e308"), ("/geometry/dso_mm",)),
    "1e999": (lambda: with_value("/geometry/dso_mm", "1e999"), ("/geometry/dso_mm", "finite")),
    "NaN": (lambda: with_value("/projections/scale", "NaN"), ("/projections/scale", "finite")),
    "minus Infinity": (lambda: with_value("/volume/voxel_mm", "[1, 1, -Infinity]"), ("/volume/voxel_mm/2", "finite")),
    "an integer of 10,000 digits": (lambda: with_value("/geometry/dso_mm", "9" * 10_000), ("scan.json",)),
    "an integer of 400 digits": (lambda: with_value("/geometry/dso_mm", "9" * 400), ("/geometry/dso_mm",)),
    "a volume without end": (lambda: with_value("/volume/shape", "[32768, 32768, 32768]"), ("/volume/shape",)),
    "nesting of 10 MB": (lambda: with_json("[" * 10_000_000), ("scan.json",)),
    "nesting of objects": (lambda: with_json('{"simulation":' + '{"a":' * 100_000 + "1" + "}" * 100_001), ("nested",)),
    "nesting that Python can follow": (lambda: with_value("/name", "[" * 500 + "]" * 500), ("nested",)),
    "a key twice": (lambda: with_json(json.dumps(SCAN)[:-1] + ', "name": "other"}'), ("twice",)),
    "many keys, one twice": (
        lambda: with_json("{" + ",".join(f'"{n}":1' for n in range(400_000)) + ',"7":1}'), ("twice",),
    ),
    "400,000 unknown keys": (lambda: with_json("{" + ",".join(f'"{n}":1' for n in range(400_000)) + "}"), ("unknown",)),
    "two million wrong numbers": (
        lambda: with_value("/geometry/angles_deg", "[" + "1e300," * 2_000_000 + "1]"), ("/geometry/angles_deg/0",),
    ),
    "two million frames that are none": (lambda: frames_of("1," * 2_000_000 + "1"), ("/geometry/frames/0",)),
    "two million times NaN": (lambda: with_value("/name", "[" + "NaN," * 2_000_000 + "1]"), ("finite",)),
    "ten million brackets": (lambda: with_value("/name", "[" + "[]," * 5_000_000 + "1]"), ("more than the",)),
    "a key of 40 MB": (lambda: with_json('{"' + "k" * 40_000_000 + '": 1}'), ("unknown",)),
    "a name of 40 MB": (lambda: with_value("/name", '"' + "n" * 40_000_000 + '"'), ("/name",)),
    "40 MB and one rare character": (lambda: with_value("/name", '"' + "n" * 40_000_000 + '\U0001f480"'), ("ASCII",)),
    "a scan.json of 100 MB": (lambda: with_json(b" " * 100_000_000), ("100000000 bytes",)),
    "UTF-16": (lambda: with_json(json.dumps(SCAN).encode("utf-16")), ("not UTF-8",)),
    "UTF-16 without a mark": (lambda: with_json(json.dumps(SCAN).encode("utf-16-le")), ("bytes of zero",)),
    "nothing but NUL": (lambda: with_json("\0" * 1000), ("not text",)),
    "no JSON": (lambda: with_json("splat"), ("not JSON",)),
    "cut off": (lambda: with_json(json.dumps(SCAN)[:-9]), ("cut off",)),
    "no object": (lambda: with_json("[1]"), ("expected one object",)),
}  # fmt: skip


def sub_ifd_loop() -> Files:
    """A page whose sub-directory is itself."""
    data = bytes([7]) * ROWS * COLS
    here = 8 + len(data)
    raw = one_page(ROWS, COLS, data, t330=(4, 1, here))
    return with_tiff(raw, detector(ROWS, COLS, 1))


def long_description() -> Files:
    raw = one_page(ROWS, COLS, bytes([7]) * 60_000_000, t270=(2, 50_000_000, 9), t279=(4, 1, ROWS * COLS))
    return with_tiff(raw, detector(ROWS, COLS, 1))


def ome(victim: str) -> Files:
    """Metadata that name another file as the one that holds the pixels."""
    xml = (
        '<?xml version="1.0"?><OME xmlns="http://www.openmicroscopy.org/Schemas/OME/2016-06"><Image ID="Image:0">'
        f'<Pixels ID="Pixels:0" DimensionOrder="XYZCT" Type="float" SizeX="{COLS}" SizeY="{ROWS}" SizeZ="{VIEWS}" '
        f'SizeC="1" SizeT="1"><TiffData IFD="0" FirstZ="0" PlaneCount="{VIEWS}"><UUID FileName="{victim}">urn:uuid:1'
        "</UUID></TiffData></Pixels></Image></OME>"
    )
    return with_tiff(tiff(good_pixels(), description=xml, metadata=None))


def reaching(how: str, scan_id: str, data: str) -> Files:
    """A scan that wants the pixels of another's."""
    relative, absolute = f"../../../scans/{scan_id}/projections.tif", f"{data}/scans/{scan_id}/projections.tif"
    if how.startswith("metadata"):
        return ome(relative if "relative" in how else absolute)
    return names(relative if "relative" in how else absolute)


# What is taken, and the facts that show it was taken for what it is.
ACCEPTED: dict[str, tuple[Callable[[], Files], dict[str, Any]]] = {
    "sub-directories in a circle": (sub_ifd_loop, {"views": 1, "dtype": "uint8"}),
    "a description of 50 MB": (long_description, {"views": 1, "dtype": "uint8"}),
    "pixels of 64 bits": (lambda: with_tiff(tiff(good_pixels("float64"))), {"dtype": "float64"}),
    "a mark of byte order": (lambda: with_json(b"\xef\xbb\xbf" + json.dumps(SCAN).encode()), {"name": "small"}),
    "nothing but zeros": (lambda: scan_files(pixels=np.zeros((VIEWS, ROWS, COLS), "float32")), {"views": VIEWS}),
    "OME metadata of a file above": (lambda: ome("../victim.tif"), {"views": VIEWS}),
}
