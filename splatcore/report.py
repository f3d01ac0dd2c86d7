"""report.html: the report as one page for a person, which loads nothing and runs no script.

The verdict comes first, then the findings, then what they rest on. The page shows whatever the report
holds and leaves out what it does not. Format "splatct-report/1":

  scan       name
  verdict    one sentence, or a list of them
  findings   [{"name", "severity": "ok|note|warning|problem", "text", "evidence": {...}}]
  views      [{"index", "residual_rms", "pose_share_before", "pose_share_after",
               "rotation_deg": [3], "translation_mm": [3],
               "sigma_rotation_deg": [3], "sigma_translation_mm": [3], ...any other number}]
  held_out   {"before", "after"}: residual RMS of views that took no part in the reconstruction
  summary, options   tables
"""

from __future__ import annotations

import importlib.resources
import math
from collections.abc import Sequence
from html import escape
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splatcore.charts import Number, Series, image_tag, line_chart, number_text
from splatcore.grid import VolumeGrid

FORMAT = "splatct-report/1"
_LEVELS = {"problem": "problem", "warning": "warning", "note": "note", "ok": "fine"}  # worst first: shown word
_WIDEST_SLICE = 512  # pixels stored; larger slices are thinned out
_SHOWN_SLICE = 280  # pixels of the page
_SAMPLE = 500_000
_CHARTED = {
    "index", "residual_rms", "pose_share_before", "pose_share_after", "rotation_deg", "translation_mm",
    "sigma_rotation_deg", "sigma_translation_mm",
}  # fmt: skip


def render(report: dict[str, Any], volume: NDArray[np.float32] | None = None, grid: VolumeGrid | None = None) -> str:
    """The page. volume [z, y, x] 1/mm gives the three middle slices."""
    name = str(report.get("scan", "scan"))
    views = [view for view in report.get("views") or [] if isinstance(view, dict)]
    parts = [
        '<!doctype html><html lang="en"><head><meta charset="utf-8">',
        '<meta name="viewport" content="width=device-width, initial-scale=1">',
        '<meta http-equiv="Content-Security-Policy" '
        "content=\"default-src 'none'; style-src 'unsafe-inline'; img-src data:\">",
        f"<title>{escape(name)}: scan report</title><style>{_style()}</style></head><body>",
        f"<header><h1>Scan report: {escape(name)}</h1>{_verdict(report.get('verdict'))}</header><main>",
        _findings(report.get("findings") or []),
        _slices(volume, grid) if volume is not None and grid is not None else "",
        _view_charts(views),
        _held_out(report.get("held_out")),
        _section("Summary", _table(report.get("summary"))),
        _section("Options", _table(report.get("options"))),
        f'</main><footer class="about">{escape(str(report.get("format", FORMAT)))}</footer></body></html>\n',
    ]
    return "\n".join(part for part in parts if part)


def _style() -> str:
    return importlib.resources.files("splatcore").joinpath("report.css").read_text(encoding="utf-8")


def _section(title: str, body: str) -> str:
    return f"<section><h2>{escape(title)}</h2>{body}</section>" if body else ""


def _verdict(verdict: Any) -> str:
    sentences = [verdict] if isinstance(verdict, str) else list(verdict or [])
    return "".join(f'<p class="verdict">{escape(str(sentence))}</p>' for sentence in sentences)


def _findings(findings: Sequence[dict[str, Any]]) -> str:
    order = list(_LEVELS)

    def rank(finding: dict[str, Any]) -> int:
        severity = finding.get("severity")
        return order.index(severity) if severity in order else len(order)

    cards = []
    for finding in sorted(findings, key=rank):
        severity = str(finding.get("severity", ""))
        level = escape(_LEVELS.get(severity, severity))
        style = f" {severity}" if severity in _LEVELS else ""
        title = escape(str(finding.get("name", "")).replace("_", " "))
        cards.append(
            f'<article class="finding{style}"><h3><span class="level">{level}</span>{title}</h3>'
            f"<p>{escape(str(finding.get('text', '')))}</p>{_table(finding.get('evidence'))}</article>"
        )
    return _section("Findings", "".join(cards))


def _table(values: Any) -> str:
    """A dict as two columns; dicts inside it as rows of their own."""
    if not isinstance(values, dict) or not values:
        return ""
    rows = "".join(
        f'<tr><th scope="row">{escape(label)}</th><td>{escape(_text(value))}</td></tr>'
        for label, value in _flat(values)
    )
    return f"<table>{rows}</table>"


def _flat(values: dict[str, Any], before: str = "") -> list[tuple[str, Any]]:
    rows: list[tuple[str, Any]] = []
    for key, value in values.items():
        label = before + str(key).replace("_", " ")
        rows += _flat(value, f"{label}: ") if isinstance(value, dict) else [(label, value)]
    return rows


def _text(value: Any) -> str:
    if value is None:
        return "–"
    if isinstance(value, bool | np.bool_):
        return "yes" if value else "no"
    if isinstance(value, int | np.integer):
        return str(value).replace("-", "−")
    if isinstance(value, float | np.floating):
        return number_text(float(value))
    if isinstance(value, list | tuple):
        return ", ".join(_text(item) for item in value[:50]) + (", …" if len(value) > 50 else "")
    return str(value)


def _number(value: Any) -> Number:
    if isinstance(value, bool) or not isinstance(value, int | float | np.integer | np.floating):
        return None
    return float(value) if -1e30 < value < 1e30 else None  # neither nan nor inf is


def _column(views: Sequence[dict[str, Any]], key: str, component: int | None = None) -> list[Number]:
    """One number of every view; None where it is missing."""
    found: list[Number] = []
    for view in views:
        value = view.get(key)
        if component is not None:
            whole = isinstance(value, list | tuple | np.ndarray) and len(value) == 3
            value = value[component] if whole and value is not None else None
        found.append(_number(value))
    return found


def _view_charts(views: Sequence[dict[str, Any]]) -> str:
    """Residual, pose share, corrections, and any other number that views carry."""
    if not views:
        return ""
    indices = [_number(view.get("index")) for view in views]
    x = [float(k) if index is None or abs(index) > 1e9 else index for k, index in enumerate(indices)]
    panels = [
        _panel(
            "Residual of each view",
            "How far the measured image is from the reconstruction's. Single peaks are single bad views.",
            x, [Series("residual", _column(views, "residual_rms"))], "residual RMS",
        ),
        _panel(
            "Share of the residual that a rigid motion explains",
            "High before and low after: the poses were wrong and were corrected. "
            "High after: some views are still misplaced, or the object moved in a way no rigid motion describes.",
            x,
            [Series("before calibration", _column(views, "pose_share_before")),
             Series("after calibration", _column(views, "pose_share_after"))],
            "share of variance",
        ),
    ]  # fmt: skip
    for key, title, unit in (("rotation", "Rotation correction", "deg"), ("translation", "Shift correction", "mm")):
        series = []
        for component, axis in enumerate("xyz"):
            sigma = _column(views, f"sigma_{key}_{unit}", component)
            drawn = sigma if any(value is not None for value in sigma) else None
            series.append(Series(f"about {axis}" if key == "rotation" else f"along {axis}",
                                 _column(views, f"{key}_{unit}", component), drawn))  # fmt: skip
        text = "What was added to each view's nominal pose"
        text += "; bars: one standard deviation." if any(line.sigma for line in series) else "."
        panels.append(_panel(title, text, x, series, unit))
    extra = sorted({key for view in views for key in view if _number(view[key]) is not None} - _CHARTED)
    panels += [_panel(key.replace("_", " "), "", x, [Series(key, _column(views, key))], "") for key in extra]
    return _section("View by view", "".join(panels))


def _panel(title: str, text: str, x: Sequence[float], series: Sequence[Series], y_label: str) -> str:
    present = [line for line in series if any(value is not None for value in line.values)]
    if not present:
        return ""
    about = f'<p class="about">{escape(text)}</p>' if text else ""
    chart = line_chart(x, present, "view", y_label)
    return f'<div class="panel"><h3>{escape(title)}</h3>{about}{chart}</div>'


def _held_out(held_out: Any) -> str:
    if not isinstance(held_out, dict):
        return ""
    before, after = _number(held_out.get("before")), _number(held_out.get("after"))
    text = "Views left out of a fresh reconstruction are predicted from it, with the poses that the full run found."
    if before is not None and after is not None and before > 0:
        change = (after - before) / before
        word = "less" if change < 0 else "more"
        text += f" Their residual went from {number_text(before)} to {number_text(after)}, {abs(change):.0%} {word}."
    return _section("Held-out views", f"<p>{escape(text)}</p>{_table(held_out)}")


def _slices(volume: NDArray[np.float32], grid: VolumeGrid) -> str:
    """The middle slice across z, y and x, seen with +z (or +y) upwards."""
    stride = max(1, math.ceil((volume.size / _SAMPLE) ** (1 / 3)))
    sample = volume[::stride, ::stride, ::stride]
    sample = sample[np.isfinite(sample)]
    low, high = (float(n) for n in np.percentile(sample, [0.5, 99.5])) if sample.size else (0.0, 1.0)
    if high <= low:
        low, high = (float(sample.min()), float(sample.max())) if sample.size else (0.0, 1.0)
    figures = []
    for axis, across in enumerate("zyx"):
        rows, cols = (step for i, step in enumerate(grid.voxel_mm) if i != axis)
        index = volume.shape[axis] // 2
        plane = np.take(volume, index, axis=axis)[::-1]
        height_mm, width_mm = plane.shape[0] * rows, plane.shape[1] * cols
        plane = plane[:: math.ceil(plane.shape[0] / _WIDEST_SLICE), :: math.ceil(plane.shape[1] / _WIDEST_SLICE)]
        gray = np.clip((np.nan_to_num(plane) - low) * (255 / max(high - low, 1e-30)), 0, 255).astype(np.uint8)
        shrink = _SHOWN_SLICE / max(height_mm, width_mm)
        size = max(1, round(width_mm * shrink)), max(1, round(height_mm * shrink))
        position = grid.axes_mm()[2 - axis][index]
        right, up = ("xy", "xz", "yz")[axis]
        caption = f"{across} = {number_text(float(position))} mm ({right} to the right, {up} up)"
        figures.append(
            f"<figure>{image_tag(gray, f'slice at {caption}', *size)}<figcaption>{caption}</figcaption></figure>"
        )
    window = f"black {number_text(low)}, white {number_text(high)} per mm"
    return _section(
        "Middle slices", f'<div class="slices">{"".join(figures)}</div><p class="about">{escape(window)}</p>'
    )
