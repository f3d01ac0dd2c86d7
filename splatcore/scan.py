"""A scan: line integrals, frames and volume, read from a folder of scan.json and TIFF files.

Everything that is wrong with a folder is found before ScanError is raised, cheap checks first: the JSON,
then the TIFF headers, then the pixels.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from splatcore.document import Document
from splatcore.errors import ScanError
from splatcore.facts import PixelFacts, ScanFacts, gather
from splatcore.geometry import Frames
from splatcore.grid import VolumeGrid, grid_from_view
from splatcore.projections import Conversion, Image, Mask, Stacks, read_images, read_stacks
from splatcore.scanjson import ScanHeader, Tolerance, read_scan_json

__all__ = ["Scan", "ScanFacts", "Tolerance", "VolumeGrid", "check_scan", "read_scan"]


@dataclass(frozen=True)
class Scan:
    """One scan, ready to be reconstructed."""

    name: str
    projections: Image  # [views, rows, cols] line integrals, unitless; bad pixels filled from their neighbours
    frames: Frames  # nominal
    volume: VolumeGrid
    time_s: tuple[float, ...] | None = None  # per view; page order is time order where None
    bad_pixels: Mask | None = None  # [rows, cols], True is bad
    strays: int = 0  # pixels of single views that stood out alone, taken from their neighbours
    exposure: tuple[float, ...] | None = None  # per view, as given; counts and transmissions were divided by it
    tolerance: Tolerance | None = None
    simulation: dict[str, Any] | None = None  # the truth of a simulated scan, for `evaluate` alone
    folder: Path | None = None


def read_scan(folder: Path | str) -> Scan:
    """The scan in a folder. Raises ScanError with every problem found."""
    folder = Path(folder)
    header, stacks, doc = _open(folder)
    conversion = Conversion(header, stacks, doc)
    images = read_images(conversion)
    return Scan(
        name=header.name,
        projections=images,
        frames=header.frames,
        volume=header.volume or grid_from_view(header.frames),
        time_s=header.time_s,
        bad_pixels=conversion.bad if conversion.bad.any() else None,
        strays=conversion.strays,
        exposure=header.exposure,
        tolerance=header.tolerance,
        simulation=header.simulation,
        folder=folder,
    )


def read_header(folder: Path | str) -> ScanHeader:
    """What scan.json says, without opening a TIFF. Raises ScanError with every problem found."""
    doc = Document()
    header = read_scan_json(Path(folder), doc)
    _raise(doc)
    assert header is not None
    return header


def check_scan(folder: Path | str, pixels: bool = True) -> ScanFacts:
    """The facts of a scan, one view in memory at a time; `pixels=False` stops at the TIFF headers.

    Raises ScanError with every problem found."""
    header, stacks, doc = _open(Path(folder))
    grid = header.volume or grid_from_view(header.frames)
    if not pixels:
        return gather(header, stacks, grid, None, None)
    conversion, facts = Conversion(header, stacks, doc), PixelFacts(header.frames)
    for index, view in enumerate(conversion.views()):
        facts.add(index, view)
    _raise(doc)
    return gather(header, stacks, grid, conversion, facts)


def _open(folder: Path) -> tuple[ScanHeader, Stacks, Document]:
    """scan.json and TIFF headers. Raises ScanError if anything is wrong with them."""
    doc = Document()
    header = read_scan_json(folder, doc)
    stacks = read_stacks(header, doc) if header is not None else None
    _raise(doc)
    assert header is not None and stacks is not None
    return header, stacks, doc


def _raise(doc: Document) -> None:
    if doc.problems:
        raise ScanError(doc.all_problems())
