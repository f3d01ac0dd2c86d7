"""What a scan is, in numbers a person can check, and what looks odd about it."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from splatcore.estimate import estimate
from splatcore.geometry import Array, Frames
from splatcore.grid import VolumeGrid
from splatcore.options import Options
from splatcore.projections import Conversion, Image, Stacks
from splatcore.redundancy import lopsidedness
from splatcore.scanjson import ScanHeader
from splatcore.stray import told

_SAMPLE = 400_000  # pixels looked at for percentiles
_FULL_TURN, _HALF_FAN = 350.0, 0.3  # degrees; share of the longer side that the shorter one lacks


@dataclass(frozen=True)
class ScanFacts:
    """Facts of a scan that passed its check. Line integrals are unitless, lengths mm, angles degrees."""

    name: str
    views: int
    rows: int
    cols: int
    dtype: str  # of the stored pixels
    kind: str
    beam: str
    by_frames: bool  # geometry given view by view
    arc_deg: float  # the part of the circle the views cover
    max_gap_deg: float  # largest step between neighbouring views inside the arc
    volume_shape: tuple[int, int, int]  # [z, y, x]
    voxel_mm: tuple[float, float, float]  # [z, y, x]
    volume_derived: bool  # from the field of view, as scan.json gives none
    bytes: int  # of the projection files
    bad_pixels: int  # per view, marked or without light
    line_integral: dict[str, float] | None  # min, p01, median, p99, max; None if pixels were not looked at
    air_level: float | None  # line integral at the image borders: 0 where the beam is open and flat
    estimated_memory_bytes: int  # rough
    estimated_seconds: float  # rough, of quality "normal" on two CPU cores
    warnings: list[str] = field(default_factory=list)

    def to_json(self) -> dict[str, Any]:
        return asdict(self)


class PixelFacts:
    """Gathers what the pixels say, one view at a time."""

    def __init__(self, frames: Frames) -> None:
        self._stride = max(1, len(frames) * frames.rows * frames.cols // _SAMPLE)
        self._stride += self._stride % frames.cols == 0 and frames.cols > 1  # not the same columns in every row
        self._samples: list[Image] = []
        self._low, self._high = math.inf, -math.inf
        self.flat_views: list[int] = []  # views of one single value
        self._air: list[float] = []
        self._sides: list[list[float]] = []  # mean of the left, right, upper, lower rim
        self._middle: list[float] = []

    def add(self, index: int, view: Image) -> None:
        low, high = float(view.min()), float(view.max())
        self._low, self._high = min(self._low, low), max(self._high, high)
        if low == high:
            self.flat_views.append(index)
            return
        self._samples.append(view.reshape(-1)[index % self._stride :: self._stride])
        rims = (view[:, :2], view[:, -2:], view[:2], view[-2:])
        self._sides.append([float(rim.mean()) for rim in rims])
        self._air.append(float(np.percentile(np.concatenate([rim.ravel() for rim in rims]), 25)))
        rows, cols = view.shape
        self._middle.append(float(np.median(view[rows // 4 : -(rows // 4) or None, cols // 4 : -(cols // 4) or None])))

    @property
    def air_level(self) -> float | None:
        return float(np.median(self._air)) if self._air else None

    def line_integral(self) -> dict[str, float]:
        if not self._samples:
            return {"min": self._low, "p01": self._low, "median": self._low, "p99": self._high, "max": self._high}
        p01, median, p99 = np.percentile(np.concatenate(self._samples), [1, 50, 99]).tolist()
        return {"min": self._low, "p01": p01, "median": median, "p99": p99, "max": self._high}

    def warnings(self, kind: str, dtype: str) -> list[str]:
        found: list[str] = []
        if self.flat_views:
            several = len(self.flat_views) > 1
            listed = ", ".join(map(str, self.flat_views[:10])) + (", ..." if len(self.flat_views) > 10 else "")
            zero = "zero" if self._low == 0 and self._high == 0 else "of one value"
            found.append(
                f"view{'s' if several else ''} {listed}: all pixels are {zero}; nothing can be learnt from them"
            )
        if self._high <= 0 and self._low < 0:
            found.append(
                f"no line integral is above zero (at most {self._high:.3g}), so there is nothing to reconstruct: check "
                "sign, kind, scale and flat"
            )
        if not self._air:
            return found
        air, values = float(np.median(self._air)), self.line_integral()
        middle = float(np.median(self._middle))
        if kind == "line_integrals" and self._high > 50 and dtype[0] in "ui":
            found.append(
                f"line integrals look like raw counts (up to {self._high:g}, stored as {dtype}): is the kind 'counts' "
                "or 'transmission', or is a scale missing?"
            )
        elif self._high > 20:
            found.append(f"values > 20 (up to {self._high:g}): a line integral of 20 lets 2e-9 of the beam through")
        if kind == "line_integrals" and air > middle + 0.1 and values["p01"] >= 0:
            found.append(
                f"line integrals look like a transmission: brighter at the border ({air:.3g}) than in the "
                f"middle ({middle:.3g}); no logarithm was taken of them"
            )
        elif air < -0.1:
            found.append(
                f"the border is brighter than the open beam (line integral {air:.3g} there): check flat, dark and scale"
            )
        found += self._truncation(air, values["p99"])
        return found

    def _truncation(self, air: float, high: float) -> list[str]:
        """Views where the object reaches the image's rim."""
        limit = max(air, 0.0) + 0.05 * (high - max(air, 0.0))
        over = np.array(self._sides) > limit  # [views, 4]
        share = over.mean(axis=0)
        found = []
        for names, shares, reason in (
            (("left", "right"), share[:2], "the field of view is too narrow for it"),
            (("top", "bottom"), share[2:], "it goes on beyond the field of view"),
        ):
            hit = [f"{name} ({part:.0%} of views)" for name, part in zip(names, shares, strict=True) if part > 0.1]
            if hit:
                found.append(f"the object is cut off at the image edge: {', '.join(hit)}; {reason}")
        return found


def arc_and_gap(frames: Frames) -> tuple[float, float]:
    """(arc covered, largest step inside it) in degrees, from the directions of the beam about z."""
    beam = frames.source if frames.beam == "cone" else -frames.source
    angles = np.sort(np.rad2deg(np.arctan2(beam[:, 1], beam[:, 0])) % 360)
    gaps: Array = np.diff(angles, append=angles[0] + 360)
    gaps = np.sort(gaps[gaps > 1e-3])
    if gaps.size < 2:
        return 0.0, 0.0
    step, widest = float(np.median(gaps[:-1])), float(gaps[-1])
    if widest > 20 and widest > 2.5 * step:
        return min(360.0, 360 - widest + step), float(gaps[-2])
    return 360.0, widest


def geometry_warnings(header: ScanHeader, grid: VolumeGrid, arc_deg: float) -> list[str]:
    frames, found = header.frames, []
    if len(frames) < 10:
        found.append(f"only {len(frames)} views")
    if arc_deg < 175:
        found.append(f"the views cover {arc_deg:.0f} degrees only; below 180 parts of the object stay unseen")
    elif arc_deg < _FULL_TURN and lopsidedness(frames) > _HALF_FAN:
        found.append(
            f"the detector is off its middle (half fan) and the views cover {arc_deg:.0f} degrees only: without a full "
            "turn the object's outer parts are seen from one side alone"
        )
    with np.errstate(divide="ignore", invalid="ignore"):  # a middle level with a source is not seen
        position = frames.project(np.array([grid.center_mm]))[:, 0]
    seen = np.all((position > -0.5) & (position < np.array([frames.cols, frames.rows]) - 0.5), axis=1)
    if seen.mean() < 0.5:
        found.append(f"the volume's middle falls off the detector in {np.count_nonzero(~seen)} of {len(frames)} views")
    if header.exposure is not None and header.kind == "line_integrals":
        spread = max(header.exposure) / min(header.exposure) - 1
        if spread > 0.01:
            found.append(
                f"the exposure differs by {spread:.0%} between views; line integrals are taken to be corrected for it"
            )
    return found


def conversion_warnings(conversion: Conversion, views: int) -> list[str]:
    found = []
    if conversion.clamped:
        share = conversion.clamped / (views * conversion.bad.size)
        found.append(
            f"{conversion.clamped} pixels ({share:.2%}) let no measurable light through; "
            f"their transmission was set to {conversion.lowest_transmission:.3g}"
        )
    if conversion.no_light:
        found.append(f"{conversion.no_light} pixels have no light in the flat image and are treated as bad")
    if conversion.strays:
        found.append(told(conversion.strays))
    bad = int(np.count_nonzero(conversion.bad))
    if bad > 0.05 * conversion.bad.size:
        found.append(f"{bad / conversion.bad.size:.0%} of the pixels are marked as bad")
    return found


def gather(
    header: ScanHeader, stacks: Stacks, grid: VolumeGrid, conversion: Conversion | None, pixels: PixelFacts | None
) -> ScanFacts:
    frames = header.frames
    arc, gap = arc_and_gap(frames)
    cost = estimate(len(frames), frames.rows, frames.cols, grid.shape, Options())
    warnings = geometry_warnings(header, grid, arc)
    dtype = stacks.images[0].dtype
    if pixels is not None:
        warnings += pixels.warnings(header.kind, dtype)
    if conversion is not None:
        warnings += conversion_warnings(conversion, len(frames))
    return ScanFacts(
        name=header.name, views=len(frames), rows=frames.rows, cols=frames.cols, dtype=dtype, kind=header.kind,
        beam=frames.beam, by_frames=header.by_frames, arc_deg=round(arc, 3), max_gap_deg=round(gap, 3),
        volume_shape=grid.shape, voxel_mm=grid.voxel_mm, volume_derived=header.volume is None, bytes=stacks.bytes,
        bad_pixels=int(np.count_nonzero(conversion.bad)) if conversion is not None else 0,
        line_integral=pixels.line_integral() if pixels is not None else None,
        air_level=pixels.air_level if pixels is not None else None,
        estimated_memory_bytes=cost.memory_bytes, estimated_seconds=cost.seconds, warnings=warnings,
    )  # fmt: skip
