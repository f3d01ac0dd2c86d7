"""Which cells make which table."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

from bench.paper.cells import METHODS, Cell
from bench.paper.published import R2_PUBLISHED
from bench.paper.scans import Projector, ScanSpec

NOISES = ((0.0, 0.0), (0.01, 0.5), (0.02, 1.0), (0.03, 1.0), (0.05, 2.5), (0.1, 5.0))  # rad, voxels
VIEWS = (75, 50, 25)
STATIC = {  # name -> what is wrong with the scanner
    "axis off by 5 px": {"offset_u_px": 5.0},
    "roll 1°": {"roll_deg": 1.0},
    "axis pitch 1°": {"axis_pitch_deg": 1.0},
    "yaw 1°": {"yaw_deg": 1.0},
}

_HEADLINE = (
    "nominal", "ours", "ceiling", "bound", "static", "matching", "R2", "paper", "FDK", "SART", "FDK, true",
    "SART, true", "CGLS, true", "R2, true", "RTK OSEM, true", "RTK SART, true", "RTK TV-CG, true",
)  # fmt: skip
_SWEEP = ("nominal", "ours", "ceiling")
RTK_PAIRS = ("FDK", "SART", "OSEM")


@dataclass(frozen=True)
class Extent:
    """What is asked for on the command line."""

    scenes: tuple[str, ...]
    edge: int
    projectors: tuple[Projector, ...]
    seed: int
    steps: int | None
    methods: tuple[str, ...] | None = None  # None: all that a table has
    views: int = 75  # where views are not what varies

    def scans(self) -> list[ScanSpec]:
        """The headline's scans."""
        return [
            ScanSpec(scene, self.edge, views=self.views, projector=projector, seed=self.seed)
            for projector in self.projectors
            for scene in self.scenes
        ]

    def cells(self, scans: Iterable[ScanSpec], labels: Iterable[str]) -> list[Cell]:
        chosen = [name for name in labels if self.methods is None or name in self.methods]
        return [Cell(scan, METHODS[label], self.steps) for scan in scans for label in chosen]


def headline(extent: Extent) -> list[Cell]:
    """Every method at 0.03 rad / 1 voxel."""
    return extent.cells(extent.scans(), _HEADLINE)


def noise(extent: Extent) -> list[Cell]:
    """The paper's sweep of pose errors."""
    scans = [replace(scan, sigma_rot=rot, sigma_trans=trans) for scan in extent.scans() for rot, trans in NOISES]
    return extent.cells(scans, (*_SWEEP, "paper"))


def views(extent: Extent) -> list[Cell]:
    """Fewer views."""
    counts = sorted({min(count, extent.views) for count in VIEWS}, reverse=True)
    scans = [replace(scan, views=count) for scan in extent.scans() for count in counts]
    return extent.cells(scans, (*_SWEEP, "R2, true", "paper"))


def right(extent: Extent) -> list[Cell]:
    """Scans whose poses were right: what does freedom cost?"""
    scans = [replace(scan, sigma_rot=0.0, sigma_trans=0.0) for scan in extent.scans()]
    return extent.cells(scans, ("nominal", "ours", "paper"))


def static(extent: Extent) -> list[Cell]:
    """Scanners with one constant error, beside true frames."""
    scans = [
        replace(scan, sigma_rot=0.0, sigma_trans=0.0, **wrong) for scan in extent.scans() for wrong in STATIC.values()
    ]
    return extent.cells(scans, ("nominal", "static", "ours", "ceiling"))


def rtk(extent: Extent) -> list[Cell]:
    """RTK with nominal frames, with ours and with the true ones."""
    labels = [f"RTK {name}, {frames}" for name in RTK_PAIRS for frames in ("nominal", "ours", "true")]
    return extent.cells(extent.scans(), labels)


def r2(extent: Extent) -> list[Cell]:
    """R2-Gaussian's own protocol: true poses, 256^3, the object's largest value 1; and ours in the same run."""
    scenes = [name for name in R2_PUBLISHED if name in extent.scenes]
    scans = [
        ScanSpec(name, 256, sigma_rot=0.0, sigma_trans=0.0, projector=projector, seed=extent.seed, to_full_range=True)
        for projector in extent.projectors
        for name in scenes
    ]
    return extent.cells(scans, ("R2, true", "ceiling"))


PRESETS = {
    "headline": headline, "noise": noise, "views": views, "right": right, "static": static, "rtk": rtk, "r2": r2,
}  # fmt: skip
EVERYTHING = tuple(name for name in PRESETS if name != "r2")  # which needs 256^3 data and hours
