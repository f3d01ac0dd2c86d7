"""From stored pixels to line integrals: scale, flat and dark, logarithm, bad and stray pixels.

Views are handled one at a time, so that a scan can be checked in little memory.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splatcore.document import Document
from splatcore.errors import ScanError
from splatcore.scanfiles import NamedFile
from splatcore.scanjson import ScanHeader
from splatcore.stray import mend_strays
from splatcore.tiff import TiffHeader, read_header, read_pages

Image = NDArray[np.float32]
Mask = NDArray[np.bool_]

MAX_PIXELS = 2**35  # 128 GiB of float32
_SMALL_BYTES, _MOST_GAIN = 2**24, 200  # pixels that take much more room than they came in are a trap
_ABSURD = 1e12  # no count and no line integral is as large
_SMALLEST_FLOAT_TRANSMISSION = 2.0**-16  # of pixels stored as floats: below one count of a 16-bit detector
_MOST_DARK_FLAT = 0.05  # share of pixels whose flat may fail to exceed the dark


@dataclass(frozen=True)
class Stacks:
    """The TIFF files of a scan, whose headers agree with scan.json."""

    images: tuple[TiffHeader, ...]
    flat: tuple[TiffHeader, ...]
    dark: tuple[TiffHeader, ...]
    bad_pixels: TiffHeader | None

    @property
    def bytes(self) -> int:
        return sum(stack.bytes for stack in self.images)


def read_stacks(header: ScanHeader, doc: Document) -> Stacks | None:
    """Headers of all files of a scan, compared with each other and with scan.json; None if anything is wrong."""
    before = len(doc.problems)
    expected = (header.frames.rows, header.frames.cols)

    def read(files: tuple[NamedFile, ...]) -> tuple[TiffHeader, ...]:
        found = []
        for file in files:
            stack, problems = read_header(file.path, file.name, len(header.frames))
            for problem in problems:
                doc.note(problem.where, problem.what, problem.hint)
            if stack is not None:
                found.append(stack)
                if stack.shape != expected:
                    _note_shape(stack, expected, doc)
        return tuple(found)

    images = read(header.files)
    broken = len(doc.problems) > before
    pages, views = sum(stack.pages for stack in images), len(header.frames)
    if images and pages != views:
        given = "frames" if header.by_frames else "angles_deg"
        hint = "give one for each page, in page order"
        if pages == 1 and len(images) == 1 and images[0].bytes > 1.9 * expected[0] * expected[1] * _size(images[0]):
            hint = "the file holds more data than its one page: save it as a multi-page BigTIFF"
        elif broken:
            hint = "other problems of these files may be the cause"
        doc.note(f"/geometry/{given}", f"has {views} views, but the TIFF files hold {pages} pages", hint)
    if pages * expected[0] * expected[1] > MAX_PIXELS:
        doc.note("/projections/files", f"hold {pages * expected[0] * expected[1]} pixels, more than {MAX_PIXELS}")
    for stack in images[1:]:
        if stack.dtype != images[0].dtype:
            what = f"holds {stack.dtype} pixels, but {images[0].name} holds {images[0].dtype}"
            doc.note(stack.name, what, "store all views alike")
            break
    flat, dark = read(header.flat), read(header.dark)
    masks = read((header.bad_pixels,)) if header.bad_pixels else ()
    if masks and masks[0].pages != 1:
        doc.note(masks[0].name, f"has {masks[0].pages} pages, expected one", "the mask holds for all views")
    stacks = [*images, *flat, *dark, *masks]
    claimed, stored = sum(stack.claimed for stack in stacks), sum(stack.bytes for stack in stacks)
    if claimed > max(_SMALL_BYTES, _MOST_GAIN * stored):
        what = f"hold {stored} bytes that claim to be {claimed} bytes of pixels"
        doc.note("/projections/files", what, f"no image of a scanner packs more than {_MOST_GAIN} to 1")
    if len(doc.problems) > before or not images:
        return None
    return Stacks(images, flat, dark, masks[0] if masks else None)


def _size(stack: TiffHeader) -> int:
    return np.dtype(stack.dtype).itemsize


def _note_shape(stack: TiffHeader, expected: tuple[int, int], doc: Document) -> None:
    what = f"holds pages of {stack.shape[0]} rows x {stack.shape[1]} columns, but scan.json says "
    what += f"{expected[0]} rows x {expected[1]} columns"
    transposed = stack.shape == expected[::-1]
    doc.note(stack.name, what, "swap rows and cols, or transpose the images" if transposed else "correct rows and cols")


class Conversion:
    """Stored views to line integrals. Counts what it had to change."""

    def __init__(self, header: ScanHeader, stacks: Stacks, doc: Document) -> None:
        """Reads mask, flat and dark; notes in `doc` what is wrong with them."""
        shape = (header.frames.rows, header.frames.cols)
        self.header, self.stacks, self.doc = header, stacks, doc
        self.clamped = 0  # pixels whose transmission was raised to the smallest meaningful one
        self.lowest_transmission = np.inf  # the value they were raised to
        self.no_light = 0  # pixels where flat <= dark, treated as bad
        self.strays = 0  # pixels of single views that stood out alone, taken from their neighbours
        self.bad: Mask = np.zeros(shape, np.bool_)
        if stacks.bad_pixels is not None:
            self.bad = next(read_pages(stacks.bad_pixels)) != 0
        self.marked = int(np.count_nonzero(self.bad))
        self.dark = self._mean(stacks.dark) if stacks.dark else np.zeros(shape, np.float64)
        self.light = np.ones(shape, np.float64)
        if stacks.flat:
            self.light = self._mean(stacks.flat) - self.dark
            unlit = (self.light <= 0) & ~self.bad
            self.no_light = int(np.count_nonzero(unlit))
            if self.no_light > _MOST_DARK_FLAT * unlit.size:
                what = f"is not brighter than the dark image in {self.no_light} of {unlit.size} pixels"
                doc.note(stacks.flat[0].name, what, "are flat and dark swapped?")
            self.bad |= unlit
            self.light[self.bad] = 1.0
        if self.bad.all():
            doc.note(stacks.bad_pixels.name if stacks.bad_pixels else stacks.flat[0].name, "leaves no good pixel")
        elif np.count_nonzero(self.bad) > self.bad.size / 2:
            name = stacks.bad_pixels.name if stacks.bad_pixels else stacks.flat[0].name
            doc.note(name, f"marks {np.count_nonzero(self.bad)} of {self.bad.size} pixels as bad", "bad is not 0")
        self._fill = NeighbourFill(self.bad)
        given = np.array(header.exposure or np.ones(len(header.frames)))
        self._exposure = (given / given.mean()).tolist()

    def _mean(self, stacks: tuple[TiffHeader, ...]) -> NDArray[np.float64]:
        """The mean page of stacks, times scale. [rows, cols]"""
        total = np.zeros(self.bad.shape, np.float64)
        for stack in stacks:
            for number, page in enumerate(read_pages(stack)):
                with np.errstate(invalid="ignore"):  # a signalling nan
                    image = page.astype(np.float64)
                self._mend(image, stack, number)
                total += image
        return total * (self.header.scale / sum(stack.pages for stack in stacks))

    def _mend(self, image: NDArray[Any], stack: TiffHeader, number: int) -> None:
        """Notes pixels that are not finite or absurdly large, unless marked as bad; sets all such to 1."""
        if -_ABSURD < image.min() and image.max() < _ABSURD:  # false for nan
            return
        wrong = ~(np.abs(image) < _ABSURD)
        count = int(np.count_nonzero(wrong & ~self.bad))
        image[wrong] = 1.0
        if count:
            where = f"{stack.name}, page {number + 1} of {stack.pages}"
            self.doc.note(where, f"{count} pixels are NaN, infinite or too large", "list dead pixels in bad_pixels")

    def views(self) -> Iterator[Image]:
        """Line integrals, view by view in page order. Notes pages that hold pixels which are not finite."""
        exposure = iter(self._exposure)
        for stack in self.stacks.images:
            for number, page in enumerate(read_pages(stack)):
                with np.errstate(over="ignore", invalid="ignore"):
                    image = page.astype(np.float32) * np.float32(self.header.scale)
                    self._mend(image, stack, number)
                    image = self._integrals(image, stack, next(exposure))
                    self._mend(image, stack, number)
                image = self._fill(image)
                self.strays += mend_strays(image)
                yield image

    def _integrals(self, image: Image, stack: TiffHeader, exposure: float) -> Image:
        """exposure: of this view, as a share of the mean over views."""
        if self.header.kind == "line_integrals":
            return image
        step = abs(self.header.scale) / 2 if np.dtype(stack.dtype).kind in "ui" else None  # half a count
        if self.header.kind == "counts":
            light = self.light * exposure
            image = ((image - self.dark) / light).astype(np.float32)
            lowest = np.float32(_SMALLEST_FLOAT_TRANSMISSION) if step is None else (step / light).astype(np.float32)
        else:
            image = image / np.float32(exposure)
            lowest = np.float32(_SMALLEST_FLOAT_TRANSMISSION if step is None else step / exposure)
        below = (image < lowest) & ~self.bad
        count = int(np.count_nonzero(below))
        if count:
            self.clamped += count
            used = np.broadcast_to(lowest, image.shape)[below]
            self.lowest_transmission = min(self.lowest_transmission, float(used.min()))
        transmission = np.where(below | self.bad, lowest, image)
        return -np.log(transmission, dtype=np.float32)


class NeighbourFill:
    """Replaces masked pixels by the mean of their good neighbours, from the rim of each patch inwards."""

    def __init__(self, mask: Mask) -> None:
        """mask [rows, cols]: True is bad. Plans the passes once for all views."""
        rows, cols = mask.shape
        self._passes: list[tuple[NDArray[np.intp], NDArray[np.intp], Image]] = []
        known = np.pad(~mask, 1)  # a rim of unknown pixels spares the edges
        around = np.array([i * (cols + 2) + j for i in (-1, 0, 1) for j in (-1, 0, 1) if i or j])
        left = np.flatnonzero(np.pad(mask, 1))
        flat = known.ravel()
        while left.size:
            neighbours = left[:, None] + around  # [n, 8] in the padded image
            good = flat[neighbours]
            ready = good.any(axis=1)
            if not ready.any():
                break
            weight = good[ready] / np.count_nonzero(good[ready], axis=1, keepdims=True)
            target, source = left[ready], neighbours[ready]
            unpad = [(np.clip(i // (cols + 2) - 1, 0, rows - 1) * cols + np.clip(i % (cols + 2) - 1, 0, cols - 1))
                     for i in (target, source)]  # fmt: skip
            self._passes.append((unpad[0], unpad[1], weight.astype(np.float32)))
            flat[target] = True
            left = left[~ready]

    def __call__(self, image: Image) -> Image:
        """The image, filled in place."""
        pixels = image.reshape(-1)
        for target, source, weight in self._passes:
            pixels[target] = np.sum(pixels[source] * weight, axis=1)
        return image


def read_images(conversion: Conversion) -> Image:
    """All line integrals of a scan. [views, rows, cols]. Raises ScanError with every bad page."""
    frames = conversion.header.frames
    images = np.empty((len(frames), frames.rows, frames.cols), np.float32)
    for index, view in enumerate(conversion.views()):
        images[index] = view
    if conversion.doc.problems:
        raise ScanError(conversion.doc.all_problems())
    return images
