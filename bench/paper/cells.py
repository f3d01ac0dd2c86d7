"""A cell of the tables: one method on one scan, and what decides its numbers."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

from bench.paper.keys import engine_digest, key_of
from bench.paper.scans import ScanSpec


@dataclass(frozen=True)
class Method:
    """A way to a volume: what runs, on whose frames, with which options."""

    label: str
    what: str  # for the legend
    kind: str  # a key of `runners.RUNNERS`
    frames: str = "nominal"  # or "true", or "ours": those that the method "ours" found, moved onto the truth's world
    options: tuple[tuple[str, Any], ...] = ()

    @property
    def by_rtk(self) -> bool:
        return self.kind == "rtk"


def method(label: str, what: str, kind: str, frames: str = "nominal", **options: Any) -> Method:
    return Method(label, what, kind, frames, tuple(sorted(options.items())))


_KNOWN = "true frames"

METHODS = {
    found.label: found
    for found in (
        method("nominal", "this engine, trusting scan.json", "splats", calibrate="none"),
        method("static", "this engine, the scanner's constant errors alone", "splats", calibrate="static"),
        method("ours", "this engine, every view's pose", "splats", calibrate="full"),
        method("ceiling", f"this engine, {_KNOWN}", "splats", "true", calibrate="none"),
        method("R2", "R2-Gaussian by our kernels, trusting scan.json", "baseline", method="r2"),
        method("R2, true", f"R2-Gaussian by our kernels, {_KNOWN}", "baseline", "true", method="r2"),
        method("paper", "the paper's method by our kernels", "baseline", method="paper"),
        method("FDK", "our FDK, trusting scan.json", "fdk"),
        method("FDK, true", f"our FDK, {_KNOWN}", "fdk", "true"),
        method("SART", "our SART, trusting scan.json", "sart"),
        method("SART, true", f"our SART, {_KNOWN}", "sart", "true"),
        method("CGLS, true", f"our conjugate gradients, {_KNOWN}", "cgls", "true"),
        method("matching", "SART and projection matching in turn, every view's pose", "matching"),
        method("bound", "the Cramér-Rao bound of the poses", "bound", "true"),
        *(
            method(f"RTK {label}, {frames}", f"RTK's {what}, {whose}", "rtk", frames, method=name, **knobs)
            for label, name, what, knobs in (
                ("FDK", "fdk", "FDK", {"snapshots": (1,)}),
                ("SART", "sart", "SART, a view at a time", {"snapshots": (1, 2, 3), "relaxation": 1.0, "subset": 1}),
                ("OSEM", "osem", "OSEM, subsets of 5 views", {"snapshots": (1, 2, 3, 4, 5), "subset": 5}),
                ("TV-CG", "tvcg", "conjugate gradients, total variation", {"snapshots": (4, 8, 12, 24), "tv": 5e-5}),
            )
            for frames, whose in (("nominal", "nominal frames"), ("ours", "our frames"), ("true", _KNOWN))
        ),
    )
}


@dataclass(frozen=True)
class Cell:
    """One method on one scan."""

    scan: ScanSpec
    method: Method
    steps: int | None = None  # Adam steps of R2-Gaussian and of the paper's method

    def parameters(self) -> dict[str, Any]:
        """All that decides the numbers, the engine's code included."""
        engine = "" if self.method.by_rtk and self.method.frames != "ours" else engine_digest()
        asked = {"kind": self.method.kind, "frames": self.method.frames, "options": dict(self.method.options)}
        steps = self.steps if self.method.kind == "baseline" else None
        return {"scan": asdict(self.scan), **asked, "steps": steps, "engine": engine}

    @property
    def key(self) -> str:
        return key_of(self.parameters())

    def needs(self) -> Cell | None:
        """The cell whose poses this one takes."""
        return Cell(self.scan, METHODS["ours"]) if self.method.frames == "ours" else None

    def __str__(self) -> str:
        s = self.scan
        scan = f"{s.scene} {s.edge}^3 {s.sigma_rot:g}/{s.sigma_trans:g} {s.views} views ({s.projector})"
        return f"{scan}: {self.method.label}"
