"""The scanner's constant errors in words: what was found, how sure that is, and what no scan of this kind can show."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from splatcore.geometry import Frames
from splatcore.observability import UNITS, sensitivity
from splatcore.scan import Scan
from splatcore.static import NAMES, axis_column

_WORTH_TELLING_PX = 0.25  # on the detector
_TURNS = {
    "roll_deg": "the detector is rolled (turned about the line to the source) by",
    "axis_pitch_deg": "the rotation axis leans along the beam by",
    "yaw_deg": "the detector is turned about its columns by",
}
_WORDS = {
    "detector_tilt_deg": "a tilt of the detector about its rows", "v_offset_px": "an offset of the detector along v",
    "dso_mm": "the distance from source to axis", "dsd_mm": "the distance from source to detector",
    "z_shift_mm": "a shift along the axis", "cor_px": "the centre of rotation", "roll_deg": "roll",
    "axis_pitch_deg": "axis pitch", "yaw_deg": "yaw",
}  # fmt: skip


def static_findings(scan: Scan, static: dict[str, Any], sigma: dict[str, float], solved: bool) -> list[dict[str, Any]]:
    """Findings for the report: centre of rotation, alignment of the scanner, and what does not show.

    static, sigma: as in poses.json, `cor_px` a column and the others degrees from nominal; solved: false where the
    geometry was taken as given.
    """
    reach = 0.6 * float(scan.volume.half_extent_mm().max())
    left = sensitivity(scan.frames, reach)
    found = [_centre(static, sigma, scan.frames)]
    if solved:
        found.append(_alignment(static, sigma, left, scan.frames))
        found.append(_hidden(scan, sigma, left))
    return found


def _centre(static: dict[str, Any], sigma: dict[str, float], nominal: Frames) -> dict[str, Any]:
    expected = axis_column(nominal)
    off = static["cor_px"] - expected
    return {
        "name": "centre of rotation",
        "severity": "warning" if abs(off) > _WORTH_TELLING_PX else "ok",
        "text": f"The rotation axis falls on column {static['cor_px']:.2f}, {off:+.2f} px from nominal"
        f"{_doubt(sigma.get('cor_px'), 'px')}.",
        "evidence": {"cor_px": static["cor_px"], "nominal_px": expected},
    }


def _alignment(
    static: dict[str, Any], sigma: dict[str, float], left: dict[str, float], nominal: Frames
) -> dict[str, Any]:
    """Roll, pitch and yaw. Each counts by what it does at the edge of the detector."""
    edge = {
        "roll_deg": math.radians(1) * max(nominal.rows, nominal.cols) / 2,
        "axis_pitch_deg": left["axis_pitch_deg"],
        "yaw_deg": left["yaw_deg"],
    }
    told, evidence = [], {}
    for name, words in _TURNS.items():
        if not math.isfinite(sigma.get(name, math.inf)):
            continue
        value = static[name]
        evidence[name], evidence[f"sigma {name}"] = value, sigma[name]
        if abs(value) * edge[name] > _WORTH_TELLING_PX or (name == "yaw_deg" and abs(value) > 0.25):
            told.append(f"{words} {value:+.2f} degrees{_doubt(sigma[name], 'degrees')}")
    if told:
        text = "; ".join(told)
        text = text[0].upper() + text[1:] + ". Corrected in every view."
    elif evidence:
        text = "Detector and axis stand as stated, as far as the scan can tell."
    else:
        text = "A detector like this does not show how it is turned against the axis."
    return {"name": "scanner alignment", "severity": "warning" if told else "ok", "text": text, "evidence": evidence}


def _hidden(scan: Scan, sigma: dict[str, float], left: dict[str, float]) -> dict[str, Any]:
    """What was left at its nominal value, with the scanner's own tolerance as the only bound."""
    hidden = [name for name in UNITS if not math.isfinite(sigma.get(name, math.inf))]
    bounds = []
    if scan.tolerance and scan.tolerance.rotation_deg is not None:
        bounds.append(f"{scan.tolerance.rotation_deg:g} degrees")
    if scan.tolerance and scan.tolerance.translation_mm is not None:
        bounds.append(f"{scan.tolerance.translation_mm:g} mm")
    bound = f"good to the scanner's stated {' and '.join(bounds)}" if bounds else "as good as the scanner's own figures"
    named = ", ".join(f"{_WORDS[name]} ({left[name]:.2g} px per {UNITS[name]})" for name in hidden)
    text = f"The images hardly show, or do not show at all: {named}. These stay as given and are {bound}."
    if "v_offset_px" in hidden and "axis_pitch_deg" not in hidden:
        text += " An offset along v would look like a little axis pitch."
    return {
        "name": "what does not show",
        "severity": "note",
        "text": text,
        "evidence": {f"px per {UNITS[name]}, {name}": left[name] for name in hidden},
    }


def _doubt(sigma: float | None, unit: str) -> str:
    return f" (one standard deviation {sigma:.2g} {unit})" if sigma is not None and math.isfinite(sigma) else ""


def as_entries(sigma: np.ndarray) -> dict[str, float]:
    """Standard deviations [4] by name, as poses.json has them."""
    return dict(zip(NAMES, (float(value) for value in sigma), strict=True))
