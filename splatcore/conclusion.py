"""From splats and poses to a Reconstruction: voxels and the diagnosis."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from splatcore.diagnose import diagnose
from splatcore.geometry import Array, Frames, RigidMotions
from splatcore.options import Options
from splatcore.poses import Normals
from splatcore.reconstruction import Reconstruction
from splatcore.scan import Scan
from splatcore.splats import Splats


def conclude(
    scan: Scan,
    options: Options,
    splats: Splats,
    corrected: Frames,
    corrections: RigidMotions,
    static: tuple[dict[str, float], dict[str, float]],
    normals: Normals,
    sigma: tuple[Array, Array],
    gauge: str,
    timings: dict[str, float],
    began: float,
) -> Reconstruction:
    """The result of a run, whatever its method.

    options: resolved. corrections: every view's own part, after the static one; static: its entries and their standard
    deviations. normals: at the final poses and full resolution. sigma: of omega [views, 3] rad and tau [views, 3] mm.
    timings: seconds by stage, to which voxelize, diagnose and total are added; began: of the run, on time.monotonic's
    clock.
    """
    assert options.threads is not None
    start = time.monotonic()
    volume = splats.voxelize(scan.volume, options.threads)
    timings["voxelize"] = time.monotonic() - start
    start = time.monotonic()
    report = diagnose(scan, options, corrected, corrections, *static, normals, sigma, options.threads)
    timings["diagnose"] = time.monotonic() - start
    timings["total"] = time.monotonic() - began
    return Reconstruction(
        scan_name=scan.name,
        splats=splats,
        volume=volume,
        grid=scan.volume,
        nominal=scan.frames,
        corrected=corrected,
        corrections=corrections,
        sigma_rotation_deg=np.rad2deg(sigma[0]),
        sigma_translation_mm=sigma[1],
        residual_rms=normals.rms,
        static=static[0],
        static_sigma=static[1],
        gauge=gauge,
        report=report,
        options=options,
        timings=timings,
    )


def mark_partial(report: dict[str, Any], fraction: float) -> None:
    """Say first of all that the run was ended before its time. fraction: of the work that was done."""
    text = (
        f"The run was ended on request when about {fraction:.0%} of its work was done: volume and poses are not what a "
        "whole run would have found."
    )
    report["partial"] = {"fraction": fraction}
    report["verdict"] = f"{text} {report['verdict']}"
    report["findings"].insert(
        0, {"name": "partial result", "severity": "warning", "text": text, "evidence": {"fraction": fraction}}
    )
