"""From splats and poses to a Reconstruction: voxels, the scanner's static part, the diagnosis."""

from __future__ import annotations

import time

import numpy as np

from splatcore.diagnose import diagnose
from splatcore.geometry import Array, Frames, RigidMotions
from splatcore.options import Options
from splatcore.poses import Normals
from splatcore.reconstruction import Reconstruction
from splatcore.scan import Scan
from splatcore.splats import Splats
from splatcore.static import Static, split_static


def conclude(
    scan: Scan,
    options: Options,
    splats: Splats,
    corrected: Frames,
    motions: RigidMotions,
    normals: Normals,
    sigma: tuple[Array, Array],
    gauge: str,
    timings: dict[str, float],
    began: float,
) -> Reconstruction:
    """The result of a run, whatever its method.

    options: resolved. motions: of every view against nominal. normals: at the
    final poses and full resolution. sigma: of omega [views, 3] rad and tau [views, 3] mm. timings: seconds by stage,
    to which voxelize, diagnose and total are added; began: of the run, on time.monotonic's clock.
    """
    assert options.threads is not None
    start = time.monotonic()
    volume = splats.voxelize(scan.volume, options.threads)
    timings["voxelize"] = time.monotonic() - start
    # What all views share in their own axes is the scanner's; the frames have it in them either way.
    found, corrections = split_static(scan.frames, Static(), motions)
    static = found.to_json(scan.frames)
    start = time.monotonic()
    report = diagnose(scan, options, corrected, corrections, static, {}, normals, sigma, options.threads)
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
        static=static,
        gauge=gauge,
        report=report,
        options=options,
        timings=timings,
    )
