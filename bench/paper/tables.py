"""Markdown tables of what the cells found."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any

from bench.coverage import COMPONENTS
from bench.paper import published
from bench.paper.cells import METHODS
from bench.paper.plan import NOISES, RTK_PAIRS, STATIC
from bench.paper.run import Outcome
from bench.paper.scans import ScanSpec

_MISSING = "—"


class Found:
    """Outcomes by scan and method."""

    def __init__(self, outcomes: Iterable[Outcome]) -> None:
        self.outcomes = list(outcomes)
        self._by_place = {(o.cell.scan, o.cell.method.label): o for o in self.outcomes}

    def scores(self, scan: ScanSpec, label: str) -> dict[str, Any] | None:
        """None where the cell failed or was not asked for."""
        outcome = self._by_place.get((scan, label))
        return outcome.scores if outcome else None

    def value(self, scan: ScanSpec, label: str, name: str) -> float:
        """nan where there is none."""
        scores = self.scores(scan, label)
        value = math.nan if scores is None else scores.get(name)
        return math.nan if value is None else float(value)

    def scans(self) -> list[ScanSpec]:
        return list(dict.fromkeys(o.cell.scan for o in self.outcomes))

    def labels(self) -> list[str]:
        return list(dict.fromkeys(o.cell.method.label for o in self.outcomes))

    def failures(self) -> list[Outcome]:
        return [o for o in self.outcomes if o.scores is None]


def number(value: float, digits: int) -> str:
    return _MISSING if math.isnan(value) else f"{value:.{digits}f}"


def mean(values: Iterable[float]) -> float:
    """Of those that are there; nan of none."""
    there = [value for value in values if not math.isnan(value)]
    return sum(there) / len(there) if there else math.nan


def share_of_gain(nominal: float, ours: float, true: float) -> float:
    """How much of what true frames bring our frames bring, in dB; nan where true frames bring nothing."""
    return (ours - nominal) / (true - nominal) if true > nominal else math.nan


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def _name(scan: ScanSpec) -> str:
    return f"{scan.scene} ({scan.projector})"


def headline(found: Found) -> str:
    """Per scene: ours between the nominal geometry and the ceiling, pose errors beside their bound, and the paper's."""
    head = ("scene (projector)", "nominal", "paper's method, ours", "ours, raw", "ours", "ceiling", "below", "rot °",
            "bound °", "trans vox", "bound vox", "rpe px", "s", "MiB", "the paper prints")  # fmt: skip
    rows, columns = [], []
    for scan in found.scans():
        ours, ceiling = found.value(scan, "ours", "psnr_aligned"), found.value(scan, "ceiling", "psnr_aligned")
        values = (
            found.value(scan, "nominal", "psnr"), found.value(scan, "paper", "psnr_aligned"),
            found.value(scan, "ours", "psnr"), ours, ceiling, ceiling - ours,
            found.value(scan, "ours", "rot_deg_aligned"), found.value(scan, "bound", "joint_rot_deg"),
            found.value(scan, "ours", "trans_vox_aligned"), found.value(scan, "bound", "joint_trans_vox"),
            found.value(scan, "ours", "rpe_px_aligned"), found.value(scan, "ours", "seconds"),
            found.value(scan, "ours", "peak_mib"),
        )  # fmt: skip
        columns.append(values)
        pair = published.PSNR_0P03.get(scan.scene)
        rows.append((_name(scan), *_shown(values), f"{pair[0]:.2f} → {pair[1]:.2f}" if pair else _MISSING))
    means = _shown([mean(column) for column in zip(*columns, strict=True)])
    rows.append(("mean", *means, "28.50 → 33.42 (its 15)"))
    note = (
        f"PSNR in dB; `ours`, `ceiling` and pose errors aligned. The paper: 256³ truths, {published.MEAN_ROT_DEG}° and "
        f"{published.MEAN_TRANS_VOX} voxel in the mean over its 15 scenes, {published.MEAN_MINUTES} minutes a scene on "
        "an RTX A6000; its chest and head are other objects. Its `→` is R2-Gaussian's PSNR, then its own."
    )
    return table(head, rows) + "\n\n" + note


def _shown(values: Sequence[float]) -> list[str]:
    digits = (2, 2, 2, 2, 2, 2, 3, 3, 3, 3, 3, 0, 0)
    return [number(value, d) for value, d in zip(values, digits, strict=True)]


def methods(found: Found) -> str:
    """Every method's PSNR on every scan, aligned, and the mean; time and memory of the mean scan."""
    scans = found.scans()
    labels = [label for label in found.labels() if METHODS[label].kind != "bound"]
    head = ("method", *map(_name, scans), "mean", "SSIM", "rot °", "trans vox", "s", "MiB", "what it is")
    rows = []
    for label in labels:
        psnrs = [found.value(scan, label, "psnr_aligned") for scan in scans]
        means = [
            mean(found.value(scan, label, name) for scan in scans)
            for name in ("ssim_aligned", "rot_deg_aligned", "trans_vox_aligned", "seconds", "peak_mib")
        ]
        shown = [number(value, digits) for value, digits in zip(means, (4, 3, 3, 0, 0), strict=True)]
        rows.append((label, *(number(p, 2) for p in psnrs), number(mean(psnrs), 2), *shown, METHODS[label].what))
    return table(head, rows) + "\n\nPSNR in dB, aligned; the columns after `mean` are means over the scenes."


def uncertainties(found: Found) -> str:
    """Shares of aligned pose errors within one and two of the deviations that poses.json states, per component."""
    shares: dict[str, list[float]] = {}
    for scan in found.scans():
        covered = (found.scores(scan, "ours") or {}).get("coverage")
        if covered is not None:
            within = [[covered[key][component] for component in COMPONENTS] for key in ("within_1", "within_2")]
            shares[_name(scan)] = [*within[0], mean(within[0]), *within[1], mean(within[1])]
    if not shares:
        return "None stated."
    shares["mean"] = [mean(column) for column in zip(*shares.values(), strict=True)]
    head = ("scene (projector)", *(f"{name}, {c}" for name in ("1σ", "2σ") for c in (*COMPONENTS, "all")))
    rows = [(name, *(number(share, 2) for share in row)) for name, row in shares.items()]
    return table(head, rows) + "\n\nOf normal errors 0.68 lie within 1σ and 0.95 within 2σ."


def noise(found: Found) -> str:
    """Rows of scene and noise level."""
    levels = [level for level in NOISES if any((s.sigma_rot, s.sigma_trans) == level for s in found.scans())]
    order = {level: place for place, level in enumerate(levels)}
    scans = sorted(found.scans(), key=lambda s: order[(s.sigma_rot, s.sigma_trans)])

    def printed(scan: ScanSpec) -> str:
        pair = published.HEAD_BY_NOISE.get((scan.sigma_rot, scan.sigma_trans)) if scan.scene == "head" else None
        return f"{pair[0]:.2f} → {pair[1]:.2f}" if pair else _MISSING

    return _sweep(found, scans, "σ rad / voxel", lambda s: f"{s.sigma_rot:g} / {s.sigma_trans:g}", printed)


def views(found: Found) -> str:
    """Rows of scene and number of views."""
    scans = sorted(found.scans(), key=lambda s: -s.views)

    def printed(scan: ScanSpec) -> str:
        pair = published.MEAN_BY_VIEWS.get(scan.views)
        return f"{pair[0]:.2f} → {pair[1]:.2f} (mean of 15)" if pair else _MISSING

    return _sweep(found, scans, "views", lambda s: str(s.views), printed, with_baseline=True)


def _sweep(
    found: Found, scans: list[ScanSpec], varied: str, level: Callable[[ScanSpec], str],
    printed: Callable[[ScanSpec], str], with_baseline: bool = False,
) -> str:  # fmt: skip
    extra = ("R2, true", "needles, ours", "needles, R2") if with_baseline else ()
    head = (varied, "scene (projector)", "nominal", "paper's method, ours", "ours", "ceiling", "below", "rot °",
            "trans vox", *extra, "the paper prints")  # fmt: skip
    rows, gaps = [], []
    for scan in scans:
        ours, ceiling = found.value(scan, "ours", "psnr_aligned"), found.value(scan, "ceiling", "psnr_aligned")
        gaps.append(ceiling - ours)
        row = [level(scan), _name(scan), number(found.value(scan, "nominal", "psnr"), 2),
               number(found.value(scan, "paper", "psnr_aligned"), 2), number(ours, 2), number(ceiling, 2),
               number(ceiling - ours, 2), number(found.value(scan, "ours", "rot_deg_aligned"), 3),
               number(found.value(scan, "ours", "trans_vox_aligned"), 3)]  # fmt: skip
        if with_baseline:
            row.append(number(found.value(scan, "R2, true", "psnr"), 2))
            row += [number(100 * found.value(scan, label, "needles"), 2) + " %" for label in ("ours", "R2, true")]
        rows.append((*row, printed(scan)))
    worst = max((gap for gap in gaps if not math.isnan(gap)), default=math.nan)
    return (
        table(head, rows)
        + f"\n\nBelow the ceiling: {number(mean(gaps), 2)} dB in the mean, {number(worst, 2)} at worst."
    )


def right(found: Found) -> str:
    """What free poses cost where there was nothing to correct: raw PSNR."""
    head = ("scene (projector)", "poses fixed", "ours", "loss", "paper's method, ours", "loss", "what ours left alone")
    rows, losses = [], []
    for scan in found.scans():
        fixed, ours = found.value(scan, "nominal", "psnr"), found.value(scan, "ours", "psnr")
        paper = found.value(scan, "paper", "psnr")
        losses.append(fixed - ours)
        verdict = str((found.scores(scan, "ours") or {}).get("verdict") or _MISSING)
        rows.append((_name(scan), number(fixed, 2), number(ours, 2), number(fixed - ours, 3), number(paper, 2),
                     number(fixed - paper, 2), verdict))  # fmt: skip
    worst = max((loss for loss in losses if not math.isnan(loss)), default=math.nan)
    return table(head, rows) + f"\n\nRaw PSNR in dB. Worst loss of ours: {number(worst, 3)} dB."


def static(found: Found) -> str:
    """What was wrong with the scanner, what was found, and what it was worth."""
    head = ("scanner", "scene (projector)", "nominal", "static", "ours", "ceiling", "rpe px, static", "found by static")
    rows = []
    for wrong, values in STATIC.items():
        for scan in found.scans():
            if any(getattr(scan, name) != value for name, value in values.items()):
                continue
            numbers = ((found.scores(scan, "static") or {}).get("static") or {}).items()
            said = ", ".join(f"{name} {value:.3f}" for name, value in numbers if value is not None)
            rows.append((wrong, _name(scan),
                         *(number(found.value(scan, m, "psnr_aligned"), 2) for m in head[2:6]),
                         number(found.value(scan, "static", "rpe_px_aligned"), 3), said or _MISSING))  # fmt: skip
    return table(head, rows) + "\n\nPSNR in dB, aligned."


def rtk(found: Found) -> str:
    """RTK with nominal frames, ours and the true ones: what our poses are worth to another programme."""
    head = ("RTK's", "scene (projector)", "nominal", "our frames", "true frames", "share of the gain")
    rows, shares = [], []
    for name in RTK_PAIRS:
        for scan in found.scans():
            values = [
                found.value(scan, f"RTK {name}, {frames}", "psnr_aligned") for frames in ("nominal", "ours", "true")
            ]
            share = share_of_gain(values[0], values[1], values[2])
            shares.append(share)
            rows.append((name, _name(scan), *(number(v, 2) for v in values), number(100 * share, 1) + " %"))
    least = min((share for share in shares if not math.isnan(share)), default=math.nan)
    note = (
        "PSNR in dB, aligned. Our frames were moved onto the truth's world (splatcore.gauge.align) before RTK saw "
        "them; the nominal frames' volume was moved afterwards. Zero outside the inscribed cylinder. Iterations: each "
        f"the best by the truth. Share of the gain: {number(100 * mean(shares), 1)} % in the mean, "
        f"{number(100 * least, 1)} % at least."
    )
    return table(head, rows) + "\n\n" + note


def r2(found: Found) -> str:
    """R2-Gaussian's own protocol."""
    head = (
        "scene (projector)",
        "R2-Gaussian prints",
        "R2-Gaussian by our kernels",
        "ours",
        "needles, R2",
        "s, R2",
        "s, ours",
    )
    rows = []
    for scan in found.scans():
        printed = published.R2_PUBLISHED.get(scan.scene, math.nan)
        rows.append((_name(scan), number(printed, 1), number(found.value(scan, "R2, true", "psnr"), 2),
                     number(found.value(scan, "ceiling", "psnr"), 2),
                     number(100 * found.value(scan, "R2, true", "needles"), 2) + " %",
                     number(found.value(scan, "R2, true", "seconds"), 0),
                     number(found.value(scan, "ceiling", "seconds"), 0)))  # fmt: skip
    return table(head, rows) + "\n\nTrue poses, 75 views, 256³, R2 noise, the object's largest value 1. PSNR in dB."


def failures(found: Found) -> str:
    """Every cell that failed, with its reason."""
    rows = [(str(o.cell), o.reason.replace("|", "\\|")) for o in found.failures()]
    return table(("cell", "reason"), rows) if rows else "None."


TABLES: dict[str, list[tuple[str, Callable[[Found], str]]]] = {
    "headline": [
        ("0.03 rad / 1 voxel", headline),
        ("All methods, 0.03 rad / 1 voxel", methods),
        ("Stated uncertainties of ours", uncertainties),
    ],
    "noise": [("From no pose error to 0.1 rad / 5 voxels", noise)],
    "views": [("Fewer views", views)],
    "right": [("Poses that were right", right)],
    "static": [("Scanners with a constant error", static)],
    "rtk": [("RTK with our frames", rtk)],
    "r2": [("R2-Gaussian's own protocol", r2)],
}
