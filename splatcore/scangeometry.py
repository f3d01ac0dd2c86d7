"""The geometry and the volume of scan.json, checked: frames in millimetres and a voxel grid."""

from __future__ import annotations

import math
from typing import Any, get_args

import numpy as np

from splatcore import geometry
from splatcore.document import Document
from splatcore.geometry import Frames
from splatcore.grid import VolumeGrid
from splatcore.tiff import MAX_SIDE

_FAR_MM = 1e6  # a kilometre: no scanner is larger
_NEAR_MM = 1e-6
_MAX_VOXELS = 2**33  # 2048^3


def read_geometry(given: Any, doc: Document) -> Frames | None:
    at = "/geometry"
    by_frames = isinstance(given, dict) and "frames" in given
    beam = given.get("beam") if isinstance(given, dict) else None
    required = ["beam", "detector"] + ([] if by_frames else ["angles_deg"])
    if beam != "parallel" and not by_frames:
        required += ["dso_mm", "dsd_mm"]
    optional = [key for key in ("angles_deg", "frames", "dso_mm", "dsd_mm") if key not in required]
    if doc.object(given, at, required, optional) is None:
        return None
    beam = doc.choice(beam, f"{at}/beam", get_args(geometry.Beam)) if "beam" in given else None
    angles = doc.numbers(given["angles_deg"], f"{at}/angles_deg", None, -1e6, 1e6) if "angles_deg" in given else None
    distance = {key: doc.number(given[key], f"{at}/{key}", 0, _FAR_MM, "mm") if key in given else 0.0
                for key in ("dso_mm", "dsd_mm")}  # fmt: skip
    detector = _detector(given.get("detector"), by_frames, doc) if "detector" in given else None

    frames: Frames | None = None
    if by_frames:
        if detector is not None and beam in get_args(geometry.Beam):
            frames = read_frames(
                given["frames"], f"{at}/frames", "cone" if beam == "cone" else "parallel", detector[:2], doc
            )
    else:
        dso, dsd = distance["dso_mm"], distance["dsd_mm"]
        if beam == "parallel" and not ("dso_mm" in given and "dsd_mm" in given):
            dso = dsd = 0.0  # the rays are lines: where the detector stands along them is all one
        if dso is not None and dsd is not None and beam == "cone" and "dso_mm" in given and "dsd_mm" in given:
            if dso >= dsd or dso < _NEAR_MM:
                hint = "dso: source to rotation axis; dsd: source to detector"
                doc.note(f"{at}/dso_mm", f"got dso {dso:g} and dsd {dsd:g} mm, expected 0 < dso < dsd", hint)
                dso = None
        if angles is not None and not angles:
            doc.note(f"{at}/angles_deg", "is empty", "give one angle for each view")
        if angles and beam and dso is not None and dsd is not None and detector and not set(required) - set(given):
            rows, cols, pixel, offset = detector
            cone = beam == "cone"
            frames = geometry.circular(
                "cone" if cone else "parallel", np.array(angles), dso, dsd, rows, cols, pixel, offset
            )
    return frames


_Detector = tuple[int, int, tuple[float, float], tuple[float, float]]


def _detector(given: Any, by_frames: bool, doc: Document) -> _Detector | None:
    """(rows, cols, pixel [v, u] mm, offset [v, u] mm); with frames the last two only inform."""
    at = "/geometry/detector"
    required = ["rows", "cols"] + ([] if by_frames else ["pixel_mm"])
    optional = ["offset_mm"] + (["pixel_mm"] if by_frames else [])
    if doc.object(given, at, required, optional) is None:
        return None
    rows, cols = (
        doc.integer(given[key], f"{at}/{key}", 1, MAX_SIDE) if key in given else None for key in ("rows", "cols")
    )
    pixel: list[float] | None = [1.0, 1.0]
    if "pixel_mm" in given:
        pixel = doc.numbers(given["pixel_mm"], f"{at}/pixel_mm", 2, _NEAR_MM, 1e4, "[v, u]")
    elif not by_frames:
        pixel = None
    offset = doc.numbers(given.get("offset_mm", [0.0, 0.0]), f"{at}/offset_mm", 2, -1e5, 1e5, "[v, u]")
    if rows is None or cols is None or pixel is None or offset is None:
        return None
    return rows, cols, (pixel[0], pixel[1]), (offset[0], offset[1])


def read_frames(given: Any, at: str, beam: geometry.Beam, detector: tuple[int, int], doc: Document) -> Frames | None:
    """Frames given view by view, as `Frames.to_json` writes them. `at` is their JSON pointer, detector (rows, cols)."""
    items = doc.array(given, at)
    if items is None:
        return None
    if not items:
        doc.note(at, "is empty", "give one frame for each view")
        return None
    keys = ("source" if beam == "cone" else "ray", "detector_center", "u", "v")
    table = np.empty((len(items), 4, 3))
    for i, item in enumerate(items):
        if doc.full:
            return None
        table[i] = np.nan
        if doc.object(item, f"{at}/{i}", keys) is None:
            continue
        for j, key in enumerate(keys):
            vector = (
                doc.numbers(item[key], f"{at}/{i}/{key}", 3, -_FAR_MM, _FAR_MM, "(x, y, z)") if key in item else None
            )
            if vector is not None:
                table[i, j] = vector
    whole = np.asarray(np.isfinite(table).all(axis=(1, 2)))
    first, center, u, v = np.moveaxis(table, 1, 0)
    along = center - first if beam == "cone" else first
    normal = np.cross(u, v)
    lengths = [np.linalg.norm(vector, axis=1) for vector in (u, v, along, normal)]
    for i in np.flatnonzero(whole).tolist():
        size_u, size_v, size_along, size_normal = (length[i] for length in lengths)
        if size_u < _NEAR_MM or size_v < _NEAR_MM:
            doc.note(f"{at}/{i}", "u or v is zero", "u and v are the steps from pixel to pixel, in mm")
        elif size_normal < 1e-3 * size_u * size_v:
            doc.note(f"{at}/{i}", "u and v are parallel", "u is the step of one column, v of one row")
        elif size_along < _NEAR_MM or abs(along[i] @ normal[i]) < 1e-3 * size_along * size_normal:
            where = (
                "the source lies in the detector's plane" if beam == "cone" else "the ray lies in the detector's plane"
            )
            doc.note(f"{at}/{i}", where, "rays must cross the detector")
        else:
            continue
        whole[i] = False
    if not whole.all():
        return None
    if beam == "parallel":
        first = first / np.linalg.norm(first, axis=1, keepdims=True)
    return Frames(beam, first.copy(), center.copy(), u.copy(), v.copy(), detector[0], detector[1])


def read_volume_grid(given: Any, doc: Document) -> VolumeGrid | None:
    at = "/volume"
    if doc.object(given, at, ["shape", "voxel_mm"], ["center_mm"]) is None:
        return None
    shape = doc.array(given["shape"], f"{at}/shape", 3, "[z, y, x]") if "shape" in given else None
    whole = [doc.integer(n, f"{at}/shape/{i}", 1, MAX_SIDE) for i, n in enumerate(shape or [])]
    voxel = (
        doc.numbers(given["voxel_mm"], f"{at}/voxel_mm", 3, _NEAR_MM, 1e4, "[z, y, x]") if "voxel_mm" in given else None
    )
    center = doc.numbers(given.get("center_mm", [0.0] * 3), f"{at}/center_mm", 3, -1e5, 1e5, "(x, y, z)")
    numbers = [n for n in whole if n is not None]
    if len(numbers) != 3 or voxel is None or center is None:
        return None
    if math.prod(numbers) > _MAX_VOXELS:
        doc.note(f"{at}/shape", f"asks for {math.prod(numbers)} voxels, more than the {_MAX_VOXELS} allowed")
        return None
    return VolumeGrid(
        (numbers[0], numbers[1], numbers[2]), (voxel[0], voxel[1], voxel[2]), (center[0], center[1], center[2])
    )


def check_source_outside(frames: Frames, volume: VolumeGrid, doc: Document) -> None:
    if frames.beam != "cone":
        return
    inside = np.all(np.abs(frames.source - np.array(volume.center_mm)) < volume.half_extent_mm(), axis=1)
    if inside.any():
        first = int(np.argmax(inside))
        what = f"the source of view {first} lies inside the volume ({np.count_nonzero(inside)} views in all)"
        doc.note("/volume", what, "the voxels are too large, or the distance from source to axis too small")
