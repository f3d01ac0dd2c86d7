"""scan.json: what a scan folder says of itself, checked to the last key.

`read_scan_json` looks at the JSON and at the names of files, never at pixels. It notes every problem in
a Document and returns what could be understood, or None where too little could.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

from splatcore.document import Document, shown
from splatcore.geometry import Frames
from splatcore.grid import VolumeGrid
from splatcore.scanfiles import NamedFile, find_file, find_files
from splatcore.scangeometry import check_source_outside, read_geometry, read_volume_grid

FORMAT = "splatct-scan/1"
Kind = Literal["line_integrals", "transmission", "counts"]

_PER_VIEW = ("time_s", "exposure")


@dataclass(frozen=True)
class Tolerance:
    """The scanner's stated accuracy, one standard deviation of each component. None: not stated."""

    rotation_deg: float | None
    translation_mm: float | None


@dataclass(frozen=True)
class ScanHeader:
    """scan.json, understood. Nothing of it is known to fit the pixels yet."""

    name: str
    files: tuple[NamedFile, ...]
    kind: Kind
    scale: float
    flat: tuple[NamedFile, ...]
    dark: tuple[NamedFile, ...]
    bad_pixels: NamedFile | None
    frames: Frames
    by_frames: bool  # the geometry was given view by view
    volume: VolumeGrid | None
    time_s: tuple[float, ...] | None
    exposure: tuple[float, ...] | None
    tolerance: Tolerance | None
    simulation: dict[str, Any] | None


def read_scan_json(folder: Path, doc: Document) -> ScanHeader | None:
    """scan.json of a folder. Problems go into `doc`; None where files or geometry are not understood."""
    path = folder / "scan.json"
    if not folder.is_dir():
        doc.note(str(folder.name or folder), "is not a folder" if folder.exists() else "does not exist")
        return None
    if not path.is_file():
        empty = next(folder.iterdir(), None) is None
        what = "the folder is empty" if empty else "scan.json is missing"
        doc.note("scan.json", what, "a scan is a folder with scan.json and its TIFF files")
        return None
    if not path.resolve().is_relative_to(folder.resolve()):
        doc.note("scan.json", "leads out of the scan folder", "put the file itself there, not a link")
        return None
    loaded = doc.load(path)
    if loaded is None:
        return None
    optional = ["name", "volume", "bad_pixels", "exposure", "time_s", "tolerance", "simulation"]
    data = doc.object(loaded, "", ["format", "projections", "geometry"], optional)
    assert data is not None
    if "format" in data and data["format"] != FORMAT:
        doc.note("/format", f"got {shown(data['format'])}, expected {FORMAT!r}")
    name = doc.text(data["name"], "/name") if "name" in data else folder.resolve().name

    images = _projections(data, folder, doc)
    frames = read_geometry(data.get("geometry"), doc) if "geometry" in data else None
    volume = read_volume_grid(data["volume"], doc) if data.get("volume") is not None else None
    tolerance = _tolerance(data["tolerance"], doc) if data.get("tolerance") is not None else None
    simulation = data.get("simulation")
    if simulation is not None and not isinstance(simulation, dict):
        doc.note("/simulation", f"got {shown(simulation)}, expected an object")
    if images is None or frames is None:
        return None
    for key in _PER_VIEW:
        given = images[key]
        if given is not None and len(given) != len(frames):
            doc.note(f"/{key}", f"has {len(given)} items, but the geometry has {len(frames)} views")
    if volume is not None:
        check_source_outside(frames, volume, doc)
    by_frames = "frames" in data["geometry"]
    return ScanHeader(
        name=name or "", frames=frames, by_frames=by_frames, volume=volume, tolerance=tolerance,
        simulation=simulation, **images,
    )  # fmt: skip


def _projections(data: dict[str, Any], folder: Path, doc: Document) -> dict[str, Any] | None:
    """The fields of ScanHeader that concern images. `bad_pixels`, `exposure` and `time_s` may stand in
    `projections` or beside it."""
    if "projections" not in data:
        return None
    at = "/projections"
    shared = ("bad_pixels", *_PER_VIEW)
    given = doc.object(data["projections"], at, ["files", "kind"], ["scale", "flat", "dark", *shared])
    if given is None:
        return None
    kind = doc.choice(given["kind"], f"{at}/kind", get_args(Kind)) if "kind" in given else None
    scale = doc.number(given.get("scale", 1.0), f"{at}/scale", -1e12, 1e12)
    if scale is not None and abs(scale) < 1e-12:
        doc.note(f"{at}/scale", f"got {shown(given['scale'])}, expected a number other than 0")

    taken: dict[Path, str] = {}
    files = {
        key: find_files(given[key], f"{at}/{key}", folder, taken, doc) if key in given else ()
        for key in ("files", "flat", "dark")
    }
    if kind == "counts" and "flat" not in given:
        doc.note(f"{at}/flat", "missing", 'kind \'counts\' needs the open-beam image: "flat": ["flat.tif"]')
    if kind in ("line_integrals", "transmission"):
        for key in ("flat", "dark"):
            if key in given:
                doc.note(f"{at}/{key}", f"given, but kind is {kind!r}", "only kind 'counts' uses it")

    beside: dict[str, Any] = {}
    for key in shared:
        places = [(where, pool[key]) for where, pool in ((f"{at}/{key}", given), (f"/{key}", data)) if key in pool]
        if len(places) > 1:
            doc.note(f"/{key}", f"given here and in {at}", "keep one of them")
        pointer, value = places[0] if places else ("", None)
        beside[key] = None
        if value is not None and key in _PER_VIEW:
            low = -1e12 if key == "time_s" else 1e-12
            values = doc.numbers(value, pointer, low=low, high=1e12)
            beside[key] = None if values is None else tuple(values)
        elif value is not None:
            beside[key] = find_file(folder, value, pointer, doc)
    if not files["files"] or kind is None or not scale:
        return None
    return {**files, **beside, "kind": kind, "scale": scale}


def _tolerance(given: Any, doc: Document) -> Tolerance | None:
    at = "/tolerance"
    keys = ("rotation_deg", "translation_mm")
    if doc.object(given, at, [], keys) is None:
        return None
    rotation, translation = (
        doc.number(given[key], f"{at}/{key}", 0, 1e4) if given.get(key) is not None else None for key in keys
    )
    return Tolerance(rotation, translation)
