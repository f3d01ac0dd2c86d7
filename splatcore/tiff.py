"""Gray TIFF stacks from strangers: judged by their headers before a pixel is decoded.

Only plain pages count (no OME, ImageJ or series metadata, which could name other files), of one sample a
pixel, uncompressed or deflated. Nothing is decoded whose claimed size, offsets and byte counts do not fit
the file.
"""

from __future__ import annotations

import logging
import math
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import tifffile
from numpy.typing import NDArray

from splatcore.errors import Problem, ScanError

DTYPES = ("uint8", "uint16", "uint32", "int16", "int32", "float16", "float32", "float64")
MAX_PAGES = 100_000
MAX_SIDE = 32_768
_UNCOMPRESSED, _DEFLATE = 1, (8, 32946)
_DEFLATE_GAIN = 1100  # zlib packs at most 1032 to 1
_PROBLEMS_PER_FILE = 5
_MOST_VALUES = 2**20  # items of one list in a directory: where strips or tiles lie, and how long they are
_SHARED_TAG = 1024  # bytes of a tag's values; smaller ones may be written once for many pages
_TYPE_BYTES = np.array([0, 1, 1, 2, 4, 8, 1, 1, 2, 4, 8, 4, 8, 4, 0, 0, 8, 8, 8], np.uint64)  # by TIFF's type number
_PAGES_LOOKED_AT = 1000  # of a file that has more pages than it may have
_INFLATE_AT_ONCE = 2**20  # bytes

# No flavour of TIFF is looked for: finding one out reads what it says of itself, and may follow it elsewhere.
_NO_FLAVOUR: Any = {f"is_{flavour}": False for flavour in tifffile.TIFF.FILE_FLAGS}

_OWN_PIXELS = "pages may not share their pixels; save each with its own"

logging.getLogger("tifffile").addHandler(logging.NullHandler())  # what it would print, we raise


@dataclass(frozen=True)
class TiffHeader:
    """What the pages of a file agree on."""

    path: Path
    name: str  # as the user wrote it
    pages: int
    shape: tuple[int, int]  # rows, cols
    dtype: str
    bytes: int  # size of the file

    @property
    def claimed(self) -> int:
        """Bytes of its pixels once they are decoded."""
        return self.pages * math.prod(self.shape) * np.dtype(self.dtype).itemsize


def _open(stream: BinaryIO) -> tifffile.TiffFile:
    return tifffile.TiffFile(stream, _multifile=False, **_NO_FLAVOUR)


def read_header(path: Path, name: str, most_pages: int = MAX_PAGES) -> tuple[TiffHeader | None, list[Problem]]:
    """The header of a stack, and everything wrong with it. None where it cannot be used at all.

    One of far more than `most_pages` is refused before its pages are looked at."""
    try:
        with path.open("rb") as stream:
            size = path.stat().st_size
            allowed = max(most_pages, _PAGES_LOOKED_AT)
            offsets, broken = _page_offsets(stream, size, allowed)
            if not offsets:
                return None, [Problem(name, broken or "holds no image")]
            if len(offsets) > allowed:
                what = f"has more than {allowed} pages, expected at most {most_pages}"
                return None, [Problem(name, what, "one page for each view; leave out all others")]
            problems = [Problem(name, broken, "the file is cut short or damaged; copy it again")] if broken else []
            shapes: list[tuple[tuple[int, int], str]] = []
            stored = 0
            stream.seek(0)
            with _open(stream) as file:
                for number in range(len(offsets)):
                    page, wrong = _read_page(file, number, size)
                    if page is None:
                        problems.append(Problem(f"{name}, page {number + 1} of {len(offsets)}", *wrong))
                        if len(problems) >= _PROBLEMS_PER_FILE:
                            break
                    else:
                        shapes.append(page[:2])
                        stored += page[2]
                        if stored > size:
                            what = f"the pages up to this one store {stored} bytes of pixels, the file has {size}"
                            problems.append(Problem(f"{name}, page {number + 1} of {len(offsets)}", what, _OWN_PIXELS))
                            break
    except OSError as error:
        return None, [Problem(name, f"cannot be read: {error.strerror or error}")]
    except Exception as error:  # a parser fed by strangers may raise anything
        return None, [Problem(name, f"is not a usable TIFF file: {error}", "copy the file again")]
    for number, (shape, dtype) in enumerate(shapes):
        if (shape, dtype) != shapes[0]:
            first = f"{shapes[0][0][0]} x {shapes[0][0][1]} {shapes[0][1]}"
            what = f"is {shape[0]} x {shape[1]} {dtype}, but page 1 is {first}"
            problems.append(Problem(f"{name}, page {number + 1}", what, "all pages must be alike"))
            break
    if not shapes:
        return None, problems
    return TiffHeader(path, name, len(offsets), *shapes[0], size), problems


def read_pages(header: TiffHeader) -> Iterator[NDArray[Any]]:
    """The pages of a stack that `read_header` found good, one by one, as stored. [rows, cols]

    Raises ScanError where a page's compressed data turn out to be damaged."""
    with header.path.open("rb") as stream, _open(stream) as file:
        for number in range(header.pages):
            try:
                page: Any = file.pages[number]
                if int(page.compression) in _DEFLATE:
                    _require_bounded(page, stream)
                pixels = np.asarray(page.asarray(maxworkers=1))
            except Exception as error:
                where = f"{header.name}, page {number + 1} of {header.pages}"
                raise ScanError([Problem(where, f"cannot be decoded: {error}", "copy the file again")]) from error
            yield pixels


def read_stack(path: Path, name: str | None = None) -> NDArray[np.float32]:
    """A whole stack, as the truth of a simulated scan is stored. [pages, rows, cols]"""
    header, problems = read_header(path, name or path.name)
    if header is None or problems:
        raise ScanError(problems)
    stack = np.empty((header.pages, *header.shape), np.float32)
    for number, page in enumerate(read_pages(header)):
        stack[number] = page
    return stack


def _page_offsets(stream: BinaryIO, size: int, most: int) -> tuple[list[int], str]:
    """File offsets of the page directories, and what broke the chain of them (empty if nothing did).

    If there are more than `most`, one more than that many is enough to know."""
    head = stream.read(16)
    order = {b"II": "<", b"MM": ">"}.get(head[:2])
    magic = struct.unpack(order + "H", head[2:4])[0] if order and len(head) >= 8 else 0
    if magic not in (42, 43):
        return [], "is not a TIFF file" if size else "is empty"
    assert order is not None
    if magic == 43 and len(head) < 16:
        return [], "is cut short"
    count_form, entry, next_form = (order + "H", 12, order + "I") if magic == 42 else (order + "Q", 20, order + "Q")
    offset = struct.unpack(next_form, head[4:8] if magic == 42 else head[8:16])[0]
    offsets: list[int] = []
    seen: set[int] = set()
    tag_bytes = listed_bytes = 0
    while offset:
        page = f"page {len(offsets) + 1}"
        if offset >= size:
            return offsets, f"is cut short: the header of {page} lies at byte {offset}, the file ends at byte {size}"
        if offset in seen:
            return offsets, f"its page directories run in a circle after page {len(offsets)}"
        if len(offsets) > most:
            return offsets, ""
        stream.seek(offset)
        raw = stream.read(struct.calcsize(count_form))
        tags = struct.unpack(count_form, raw)[0] if len(raw) == struct.calcsize(count_form) else 0
        listed = stream.read(tags * entry) if tags < 4096 else b""
        following = stream.read(struct.calcsize(next_form)) if len(listed) == tags * entry else b""
        if len(following) < struct.calcsize(next_form):
            return offsets, f"is cut short: the header of {page} lies at byte {offset}, the file ends at byte {size}"
        listed_bytes += len(listed)
        if listed_bytes > size:
            return [], f"its page directories up to {page} lie on top of each other"
        longest, large = _tag_values(listed, order, entry)
        tag_bytes += large
        if longest > _MOST_VALUES:
            return [], f"a list in the directory of {page} has {longest} items, more than the {_MOST_VALUES} allowed"
        if tag_bytes > size:
            return [], f"its page directories up to {page} claim {tag_bytes} bytes of values, the file has {size}"
        seen.add(offset)
        offsets.append(offset)
        offset = struct.unpack(next_form, following)[0]
    return offsets, ""


def _tag_values(listed: bytes, order: str, entry: int) -> tuple[int, int]:
    """(items of the longest list of numbers, bytes of all large values) that a directory's entries point to.

    A file that holds each large value once has room for all of them; one that lets its pages share them would have
    them read again and again."""
    wide = {12: "u4", 20: "u8"}[entry]
    fields = [("tag", order + "u2"), ("type", order + "u2"), ("count", order + wide), ("value", order + wide)]
    tags = np.frombuffer(listed, np.dtype(fields))
    each = _TYPE_BYTES[np.minimum(tags["type"], len(_TYPE_BYTES) - 1)]
    sizes = tags["count"].astype(np.float64) * each  # a float cannot overflow
    longest = tags["count"][each > 1].max(initial=0)
    return int(longest), int(sizes[sizes > _SHARED_TAG].sum())


def _require_bounded(page: Any, stream: BinaryIO) -> None:
    """Raises ValueError where a compressed piece holds more than its share of the pixels. The decoder would make
    room for it all, thousands of times what is stored."""
    most = math.prod(page.chunks) * page.dtype.itemsize
    for start, length in zip(page.dataoffsets, page.databytecounts, strict=True):
        stream.seek(start)
        inflate, left, total = zlib.decompressobj(), stream.read(length), 0
        while left and not inflate.eof:
            total += len(inflate.decompress(left, _INFLATE_AT_ONCE))
            left = inflate.unconsumed_tail
            if total > most:
                raise ValueError(f"its data inflate to more than the {most} bytes of their pixels")


def _read_page(
    file: tifffile.TiffFile, number: int, size: int
) -> tuple[tuple[tuple[int, int], str, int] | None, tuple[str, str]]:
    """((rows, cols), dtype, bytes stored) of one page, or what is wrong with it and a hint."""
    try:
        page: Any = file.pages[number]
        shape, dtype = tuple(int(n) for n in page.shape), page.dtype
        samples, predictor = int(page.samplesperpixel), int(page.predictor)
        compression = int(page.compression)
        starts, lengths = page.dataoffsets, page.databytecounts
        segments = math.prod(page.chunked) if page.chunks else 0
        claimed = math.prod(shape) * (dtype.itemsize if dtype is not None else 0)
        segment_bytes = math.prod(page.chunks) * (dtype.itemsize if dtype is not None else 0)
    except Exception as error:  # a parser fed by strangers may raise anything
        return None, (f"its header is damaged: {error}", "copy the file again")
    kind = str(dtype) if dtype is not None else f"{page.bitspersample}-bit"
    if samples != 1 or int(page.photometric) == 3:
        return None, (f"has {samples} samples a pixel or a palette", "save it as single-channel grayscale")
    if kind not in DTYPES:
        return None, (f"holds {kind} pixels", f"expected one of {', '.join(DTYPES)}")
    if len(shape) != 2 or not all(0 < n <= MAX_SIDE for n in shape):
        return None, (f"has shape {' x '.join(map(str, shape))}", f"expected rows x cols, each up to {MAX_SIDE}")
    if compression not in (_UNCOMPRESSED, *_DEFLATE):
        scheme = getattr(page.compression, "name", str(compression))
        return None, (f"is compressed with {scheme}", "save it uncompressed or with deflate (zip) compression")
    if predictor not in (1, 2) or (predictor == 2 and kind.startswith("float")):
        return None, (f"uses predictor {predictor} on {kind}", "save it without a predictor")
    if len(starts) != len(lengths) or len(starts) < segments or not segments or 0 in lengths[:segments]:
        return None, ("does not say where all its pixels are", "the file is cut short or damaged; copy it again")
    end = max(start + length for start, length in zip(starts, lengths, strict=True))
    if end > size:
        return None, (f"its pixels end at byte {end}, the file at byte {size}", "the file is cut short; copy it again")
    stored = sum(lengths)
    if compression == _UNCOMPRESSED and stored < claimed:
        return None, (f"claims {claimed} bytes of pixels and stores {stored}", "the file is damaged")
    if claimed > stored * _DEFLATE_GAIN or max(lengths) > 1.1 * segment_bytes + 4096:
        return None, (f"claims {claimed} bytes of pixels out of {stored} stored ones", "the file is damaged")
    return (shape, kind, stored), ("", "")
