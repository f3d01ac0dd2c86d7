"""The report page: complete, escaped, self-contained, and drawn where the numbers say."""

from __future__ import annotations

import base64
import io
import math
import re
from html.parser import HTMLParser
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from splatcore.charts import Series, line_chart, number_text, png_bytes, ticks
from splatcore.grid import VolumeGrid
from splatcore.report import render

VOID = {"meta", "img", "br", "link"}


class Page(HTMLParser):
    """The page's elements and text; fails on tags that do not nest."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.words = ""
        self.feed(text)
        self.close()
        assert not self.open, f"left open: {self.open}"

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] != "style":
            self.words += data

    def all(self, tag: str) -> list[dict[str, str | None]]:
        return [attributes for name, attributes in self.elements if name == tag]


def report(views: int = 30) -> dict[str, Any]:
    rng = np.random.default_rng(0)
    return {
        "format": "splatct-report/1",
        "scan": "teapot",
        "verdict": ["The geometry was wrong and was corrected.", "The volume can be trusted."],
        "findings": [
            {"name": "noise", "severity": "ok", "text": "As expected.", "evidence": {}},
            {"name": "pose_jitter", "severity": "problem", "text": "Views jump.", "evidence": {"rms_deg": 2.91}},
            {"name": "truncation", "severity": "note", "text": "None.", "evidence": {"sides": ["left", "top"]}},
        ],
        "views": [
            {
                "index": k,
                "residual_rms": 0.01 + 0.001 * rng.random(),
                "pose_share_before": 0.8,
                "pose_share_after": 0.05,
                "rotation_deg": rng.normal(0, 1, 3).tolist(),
                "translation_mm": rng.normal(0, 1, 3).tolist(),
                "sigma_rotation_deg": [0.1, 0.1, None],
                "sigma_translation_mm": [0.1, 0.2, 0.3],
                "flux": 1.0 + 0.01 * k,
            }
            for k in range(views)
        ],
        "held_out": {"before": 0.04, "after": 0.01},
        "summary": {"splats": 30000, "static": {"cor_px": -1.25}},
        "options": {"calibrate": "full", "threads": None},
    }


def test_everything_is_on_the_page() -> None:
    page = Page(render(report()))
    for words in (
        "The geometry was wrong and was corrected.", "The volume can be trusted.", "pose jitter", "Views jump.",
        "rms deg", "2.91", "left, top", "30000", "static: cor px", "−1.25", "calibrate", "full",
        "went from 0.04 to 0.01, 75% less", "before calibration", "after calibration", "flux", "splatct-report/1",
    ):  # fmt: skip
        assert words in page.words, words
    assert len(page.all("svg")) == 5  # residual, share, rotation, shift, flux


def test_the_verdict_comes_first_then_the_worst_finding() -> None:
    words = Page(render(report())).words
    order = ["The geometry was wrong", "Views jump.", "None.", "As expected.", "Residual of each view", "calibrate"]
    places = [words.index(part) for part in order]
    assert places == sorted(places)


def test_nothing_is_loaded_and_nothing_runs() -> None:
    text = render(report(), *small_volume())
    page = Page(text)
    assert not {tag for tag, _ in page.elements} & {"script", "link", "iframe", "object", "form"}
    for _, attributes in page.elements:
        for name, value in attributes.items():
            assert not name.startswith("on") and name not in ("href", "style")
            if name == "src":
                assert value is not None and value.startswith("data:image/png;base64,")
    assert "http://" not in text and "https://" not in text and "url(" not in text and "@import" not in text


NASTY = "</style><script>alert(1)</script>\"'&<img src=x onerror=alert(1)>"


def test_what_strangers_write_stays_text() -> None:
    given_report = report(3)
    given_report |= {"scan": NASTY, "verdict": NASTY, "summary": {NASTY: NASTY}, "options": {NASTY: [NASTY]}}
    given_report["findings"] = [{"name": NASTY, "severity": NASTY, "text": NASTY, "evidence": {NASTY: {NASTY: NASTY}}}]
    given_report["views"][0][NASTY] = 1.0
    page = Page(render(given_report))
    assert not page.all("script") and not page.all("img")
    assert page.words.count("alert(1)") >= 10


@given(
    st.recursive(
        st.none() | st.booleans() | st.floats() | st.integers() | st.text(max_size=8),
        lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=8), inner, max_size=3),
        max_leaves=8,
    )
)
@settings(max_examples=60, deadline=None)
def test_any_values_make_a_page(value: Any) -> None:
    keys = ("residual_rms", "rotation_deg", "sigma_rotation_deg", "pose_share_after", "index", "x")
    Page(
        render(
            {
                "scan": value,
                "verdict": str(value),
                "findings": [{"name": value, "severity": value, "text": value, "evidence": value}],
                "views": [dict.fromkeys(keys, value), {}, dict.fromkeys(keys, 1.0)],
                "held_out": value,
                "summary": value,
                "options": {"a": value},
            }
        )
    )


def test_an_empty_report_makes_a_page() -> None:
    page = Page(render({}))
    assert not page.all("svg") and not page.all("img") and not page.all("h2")


def small_volume() -> tuple[np.ndarray, VolumeGrid]:
    volume = np.zeros((4, 6, 8), np.float32)
    volume[2, 0, 0] = 1  # on the middle slice across z, at low y and low x
    return volume, VolumeGrid((4, 6, 8), (2.0, 1.0, 1.0))


def test_slices_have_their_shape_and_up_is_up() -> None:
    images = Page(render({}, *small_volume())).all("img")
    pixels = []
    for image in images:
        raw = base64.b64decode((image["src"] or "").split(",")[1])
        pixels.append(np.asarray(Image.open(io.BytesIO(raw))))
    assert [image.shape for image in pixels] == [(6, 8), (4, 8), (4, 6)]
    assert pixels[0][5, 0] == 255 and pixels[0].sum() == 255, "low y is at the bottom"
    sizes = [(int(image["width"] or 0), int(image["height"] or 0)) for image in images]
    assert sizes == [(280, 210), (280, 280), (210, 280)], "shown in millimetres"


def test_a_volume_without_contrast_is_drawn() -> None:
    grid = VolumeGrid((3, 3, 3), (1.0, 1.0, 1.0))
    for value in (0.0, 1.0, np.nan):
        assert len(Page(render({}, np.full((3, 3, 3), value, np.float32), grid)).all("img")) == 3


def test_large_slices_are_thinned() -> None:
    grid = VolumeGrid((1, 1, 1500), (1.0, 1.0, 1.0))
    text = render({}, np.random.default_rng(0).random((1, 1, 1500), np.float32), grid)
    raw = base64.b64decode((Page(text).all("img")[0]["src"] or "").split(",")[1])
    assert Image.open(io.BytesIO(raw)).size == (500, 1)


@given(st.integers(1, 20), st.integers(1, 20), st.integers(0, 2**32 - 1))
@settings(max_examples=20, deadline=None)
def test_png_is_lossless(rows: int, cols: int, seed: int) -> None:
    gray = np.random.default_rng(seed).integers(0, 256, (rows, cols), dtype=np.uint8)
    image = Image.open(io.BytesIO(png_bytes(gray)))
    assert image.mode == "L"
    np.testing.assert_array_equal(np.asarray(image), gray)


def points(svg: str) -> list[list[tuple[float, float]]]:
    """The pieces of the first line of a chart, in SVG coordinates."""
    match = re.search(r'class="line" d="([^"]*)"', svg)
    assert match
    pieces = [piece for piece in match[1].split("M") if piece]
    return [[(float(x), float(y)) for x, y in (p.split(" ") for p in piece.split("L"))] for piece in pieces]


def test_a_line_is_drawn_to_scale_and_breaks_at_gaps() -> None:
    first, second = points(line_chart([0, 1, 2, 3, 4], [Series("a", [0.0, 5.0, None, 10.0, 2.5])], "view", "y"))
    assert [len(first), len(second)] == [2, 2]
    (x0, y0), (x1, y5), (x3, y10) = first[0], first[1], second[0]
    assert y0 > y5 > y10, "large values are high on the page"
    assert y0 - y5 == pytest.approx(y5 - y10, abs=0.2)
    assert x3 - x0 == pytest.approx(3 * (x1 - x0), abs=0.2)


def test_error_bars_reach_one_sigma_each_way() -> None:
    svg = line_chart([0, 1], [Series("a", [0.0, 2.0], [None, 1.0])], "view", "y")
    bars = re.findall(r'class="bar" d="([^"]*)"', svg)
    assert len(bars) == 1 and bars[0].count("M") == 1
    low, high = (float(n) for n in re.fullmatch(r"M[\d.]+ ([\d.]+)V([\d.]+)", bars[0]).groups())  # type: ignore[union-attr]
    (line,) = points(svg)
    per_unit = (line[0][1] - line[1][1]) / 2
    assert (low - high) / 2 == pytest.approx(per_unit, abs=0.1)
    assert (low + high) / 2 == pytest.approx(line[1][1], abs=0.1)


@given(st.lists(st.none() | st.floats(-1e30, 1e30) | st.just(math.nan), max_size=5))
def test_any_numbers_make_a_chart(values: list[float | None]) -> None:
    svg = line_chart([float(k) for k in range(len(values))], [Series("a", values)], "view", "y")
    assert "nan" not in svg and "inf" not in svg


@given(st.floats(-1e6, 1e6), st.floats(1e-6, 1e6))
def test_ticks_are_few_and_cover_the_range(low: float, width: float) -> None:
    high = low + width
    marks = ticks(low, high)
    step = marks[1] - marks[0]
    assert marks[0] <= low + 1e-6 * step and marks[-1] >= high - 1e-6 * step
    assert 2 <= len(marks) <= 8


def test_numbers_are_short() -> None:
    assert [number_text(n) for n in (0.0, 1234.6, 127.44, -0.012345, 1e-5, 2.5e7, math.inf)] == [
        "0", "1235", "127.4", "−0.0123", "1.00e−05", "2.50e+07", "–",
    ]  # fmt: skip
