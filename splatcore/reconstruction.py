"""What a reconstruction is: splats, volume, poses with their uncertainty, and the report."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splatcore.geometry import Array, Frames, RigidMotions
from splatcore.grid import VolumeGrid
from splatcore.options import Options
from splatcore.splats import Splats


@dataclass(frozen=True)
class Reconstruction:
    """Everything one run found out about one scan."""

    scan_name: str
    splats: Splats
    volume: NDArray[np.float32]  # [z, y, x] 1/mm
    grid: VolumeGrid
    nominal: Frames  # as the scan gave them
    corrected: Frames  # static and per-view corrections applied
    corrections: RigidMotions  # per view, after the static part
    sigma_rotation_deg: Array  # [views, 3] one standard deviation; inf: not observable, NaN: not moved
    sigma_translation_mm: Array  # [views, 3] likewise
    residual_rms: Array  # [views] in line-integral units
    static: dict[str, Any]  # the scanner's constant errors: "cor_px", "roll_deg", ...; what was turned round
    gauge: str  # how the freedoms that no projection shows were fixed
    report: dict[str, Any]  # splatct-report/1
    options: Options  # resolved: no None left
    static_sigma: dict[str, float] = field(default_factory=dict)  # by name; inf: not observable
    timings: dict[str, float] = field(default_factory=dict)  # seconds by stage
    device: str = "cpu"
