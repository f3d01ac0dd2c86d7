"""poses.json (splatct-poses/1): corrected frames, corrections and their uncertainty, out and in."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from splatcore.document import Document, shown
from splatcore.errors import Problem, ScanError
from splatcore.geometry import Array, Frames
from splatcore.reconstruction import Reconstruction
from splatcore.scangeometry import read_frames

FORMAT = "splatct-poses/1"
_UNSEEN = "sigma null: this direction or parameter does not show in the projections; it was left at its nominal value"
_UNMOVED = "sigma null: no view was moved, so nothing is stated of how well its pose is known"


def poses_document(r: Reconstruction) -> dict[str, Any]:
    """poses.json of a reconstruction. Numbers that are not finite become null, and notes say why."""
    omega, tau = r.corrections.vectors()
    rotation = np.rad2deg(omega)
    views = [
        {
            "index": k,
            "frame": frame,
            "correction": {"rotation_deg": rotation[k].tolist(), "translation_mm": tau[k].tolist()},
            "sigma": {
                "rotation_deg": _finite(r.sigma_rotation_deg[k]),
                "translation_mm": _finite(r.sigma_translation_mm[k]),
            },
            "residual_rms": _finite(r.residual_rms[k : k + 1])[0],
        }
        for k, frame in enumerate(r.corrected.to_json())
    ]
    document = {
        "format": FORMAT,
        "beam": r.corrected.beam,
        "detector": {"rows": r.corrected.rows, "cols": r.corrected.cols},
        "views": views,
        "static": {name: _plain(value) for name, value in r.static.items()},
        "static_sigma": {name: _plain(value) for name, value in r.static_sigma.items()},
        "gauge": r.gauge,
    }
    sigmas = (r.sigma_rotation_deg, r.sigma_translation_mm, np.array(list(r.static_sigma.values())))
    notes = {_UNMOVED: np.isnan, _UNSEEN: np.isinf}
    said = [note for note, which in notes.items() if any(which(sigma).any() for sigma in sigmas)]
    return document | ({"notes": said} if said else {})


def _plain(value: float | bool) -> float | bool | None:
    if isinstance(value, bool):
        return value
    return float(value) if math.isfinite(value) else None


def _finite(values: Array) -> list[float | None]:
    return [float(value) if math.isfinite(value) else None for value in values]


def read_poses(path: Path, detector: tuple[int, int] | None = None) -> tuple[dict[str, Any], Frames]:
    """poses.json and its corrected frames. `detector` (rows, cols) serves files that do not say it.

    Raises ScanError with every problem found."""
    doc = Document()
    data = doc.load(path)
    frames: Frames | None = None
    if data is not None:
        if data.get("format") != FORMAT:
            doc.note("/format", f"got {shown(data.get('format'))}, expected {FORMAT!r}")
        views = doc.array(data.get("views"), "/views")
        given = [view.get("frame") if isinstance(view, dict) else view for view in views or []]
        parallel = bool(given) and isinstance(given[0], dict) and "ray" in given[0]
        beam = doc.choice(data.get("beam", "parallel" if parallel else "cone"), "/beam", ("cone", "parallel"))
        size = data.get("detector")
        if isinstance(size, dict):
            rows = doc.integer(size.get("rows"), "/detector/rows", 1, 2**20)
            cols = doc.integer(size.get("cols"), "/detector/cols", 1, 2**20)
            detector = (rows, cols) if rows and cols else None
        elif detector is None:
            doc.note("/detector", "missing", 'give {"rows": ..., "cols": ...}')
        if views is not None and beam and detector:
            frames = read_frames(given, "/views", "cone" if beam == "cone" else "parallel", detector, doc)
    if data is None or frames is None or doc.problems:
        raise ScanError(doc.all_problems())
    return data, frames


def frames_for(given: Frames, path: Path) -> Frames:
    """The frames of poses.json in place of a scan's own. Raises ScanError where they are of another kind of scan."""
    _, frames = read_poses(path, (given.rows, given.cols))
    for what, theirs, ours in (
        ("beam", frames.beam, given.beam),
        ("views", len(frames), len(given)),
        ("detector (rows, cols)", (frames.rows, frames.cols), (given.rows, given.cols)),
    ):
        if theirs != ours:
            hint = "give the poses of a scan with the same views on the same scanner"
            raise ScanError([Problem(str(path), f"{what}: the poses have {theirs}, the scan {ours}", hint)])
    return frames
