"""Line charts as inline SVG and slices as inline PNG, for pages that load nothing.

Colours come from the page's style sheet: series k has the class `s0`, `s1`, ... so that dark and light
follow the reader. Standard library and numpy only.
"""

from __future__ import annotations

import base64
import math
import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from typing import TypeGuard

import numpy as np
from numpy.typing import NDArray

Number = float | None  # None, not finite or absurdly large: nothing is drawn there

WIDTH, HEIGHT = 720, 220
_LEFT, _RIGHT, _TOP, _BOTTOM = 64, 12, 12, 40
_ABSURD, _NOTHING = 1e30, 1e-30
_MARKED = 120  # up to so many points each gets a dot


@dataclass(frozen=True)
class Series:
    """One line. `sigma` gives each point a bar of one standard deviation each way."""

    name: str
    values: Sequence[Number]
    sigma: Sequence[Number] | None = None


def number_text(value: float) -> str:
    """Three significant digits, four from a hundred on, as a person writes them."""
    if not math.isfinite(value):
        return "–"
    if value == 0 or 1e-3 <= abs(value) < 1e5:
        text = f"{value:.{3 if abs(value) < 100 else 4}g}" if abs(value) < 1000 else f"{value:.0f}"
        return text.replace("-", "−")
    return f"{value:.2e}".replace("-", "−")


def ticks(low: float, high: float, about: int = 5) -> list[float]:
    """Round numbers that cover low to high, about so many."""
    step = 10.0 ** math.floor(math.log10((high - low) / about))
    for factor in (1, 2, 5, 10):
        if (high - low) / (step * factor) <= about:
            step *= factor
            break
    first, last = math.floor(low / step + 1e-9), math.ceil(high / step - 1e-9)
    return [k * step for k in range(first, last + 1)]


def line_chart(
    x: Sequence[float], series: Sequence[Series], x_label: str, y_label: str, top: float | None = None
) -> str:
    """An SVG chart. The y axis contains 0, and reaches to `top` where that is given."""
    ends = [0.0] if top is None else [0.0, top]
    for line in series:
        bars: Sequence[Number] = line.sigma or [0.0] * len(line.values)
        for value, sigma in zip(line.values, bars, strict=True):
            if _drawn(value):
                spread = sigma if _drawn(sigma) else 0.0
                ends += [value - spread, value + spread]
    low, high = min(ends), max(ends)
    marks = ticks(low, high if high - low > _NOTHING else low + 1)
    low, high = marks[0], marks[-1]
    left, right = (min(x), max(x)) if len(x) else (0.0, 1.0)
    if right <= left:
        left, right = left - 0.5, right + 0.5

    def px(value: float) -> str:
        return f"{_LEFT + (value - left) / (right - left) * (WIDTH - _LEFT - _RIGHT):.1f}"

    def py(value: float) -> str:
        return f"{HEIGHT - _BOTTOM - (value - low) / (high - low) * (HEIGHT - _TOP - _BOTTOM):.1f}"

    parts = [
        f'<svg class="chart" viewBox="0 0 {WIDTH} {HEIGHT}" role="img" '
        f'aria-label="{escape(y_label)} against {escape(x_label)}">'
    ]
    for mark in marks:
        axis = ' class="zero"' if mark == 0 else ""
        parts.append(f'<path{axis} d="M{_LEFT} {py(mark)}H{WIDTH - _RIGHT}"/>')
        parts.append(f'<text class="y" x="{_LEFT - 6}" y="{py(mark)}">{number_text(mark)}</text>')
    for mark in ticks(left, right, 8):
        if left <= mark <= right:
            parts.append(f'<text class="x" x="{px(mark)}" y="{HEIGHT - _BOTTOM + 16}">{number_text(mark)}</text>')
    middle = (_TOP + HEIGHT - _BOTTOM) / 2
    parts.append(f'<text class="x" x="{(_LEFT + WIDTH - _RIGHT) / 2}" y="{HEIGHT - 6}">{escape(x_label)}</text>')
    parts.append(f'<text class="x" transform="translate(13 {middle}) rotate(-90)">{escape(y_label)}</text>')
    for k, line in enumerate(series):
        parts.append(f'<g class="s{k}"><title>{escape(line.name)}</title>')
        if line.sigma is not None:
            strokes = "".join(
                f"M{px(at)} {py(value - sigma)}V{py(value + sigma)}"
                for at, value, sigma in zip(x, line.values, line.sigma, strict=True)
                if _drawn(value) and _drawn(sigma)
            )
            parts.append(f'<path class="bar" d="{strokes}"/>' if strokes else "")
        points = [(px(at), py(value)) if _drawn(value) else None for at, value in zip(x, line.values, strict=True)]
        parts.append(f'<path class="line" d="{_path(points)}"/>')
        if len(points) <= _MARKED:
            parts += [f'<circle cx="{p[0]}" cy="{p[1]}" r="1.8"/>' for p in points if p]
        parts.append("</g>")
    return "".join(parts) + "</svg>" + _legend(series)


def _legend(series: Sequence[Series]) -> str:
    if len(series) < 2:
        return ""
    keys = "".join(f'<span class="s{k}"><i></i>{escape(line.name)}</span>' for k, line in enumerate(series))
    return f'<p class="legend">{keys}</p>'


def _drawn(value: Number) -> TypeGuard[float]:
    return value is not None and abs(value) < _ABSURD


def _path(points: Sequence[tuple[str, str] | None]) -> str:
    """A polyline, interrupted where a point is missing."""
    text, pen = "", "M"
    for point in points:
        if point is None:
            pen = "M"
        else:
            text += f"{pen}{point[0]} {point[1]}"
            pen = "L"
    return text


def png_bytes(gray: NDArray[np.uint8]) -> bytes:
    """An 8-bit grayscale PNG. gray [rows, cols]"""
    rows, cols = gray.shape
    raw = np.zeros((rows, cols + 1), np.uint8)  # each row begins with its filter type, 0
    raw[:, 1:] = gray

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    head = struct.pack(">IIBBBBB", cols, rows, 8, 0, 0, 0, 0)
    body = chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(raw.tobytes(), 6)) + chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + body


def image_tag(gray: NDArray[np.uint8], alt: str, width: int, height: int) -> str:
    """An <img> that carries its own pixels, shown at width x height."""
    data = base64.b64encode(png_bytes(gray)).decode("ascii")
    return f'<img alt="{escape(alt)}" width="{width}" height="{height}" src="data:image/png;base64,{data}">'
