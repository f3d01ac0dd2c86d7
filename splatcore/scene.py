"""A scan in R2-Gaussian's units, in which its learning rates and thresholds are stated.

The widest side of the volume is 2, and an attenuation of 1 is that of the densest matter. Lengths are thus divided by
half the width L (mm), densities by a unit U (1/mm), and line integrals by L U.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from splatcore.errors import ReconstructionError
from splatcore.geometry import Frames, RigidMotions
from splatcore.grid import VolumeGrid
from splatcore.scan import Scan
from splatcore.splats import Floats, Splats
from splatcore.start import fdk

_DENSEST = 99.99  # percentile of the first volume that is taken for its largest value: its very largest is noise


@dataclass(frozen=True)
class Scene:
    """One scan without physical units."""

    length_mm: float  # half of the volume's widest side
    unit: float  # 1/mm
    frames: Frames  # nominal
    images: Floats  # [views, rows, cols]
    mask: Floats | None  # [rows, cols]
    grid: VolumeGrid
    volume: Floats  # [z, y, x] FDK with the nominal frames and no window on the ramp

    def splats_mm(self, splats: Splats) -> Splats:
        """The same splats in mm and 1/mm."""
        length, unit = np.float32(self.length_mm), np.float32(self.unit)
        return Splats(splats.means * length, splats.scales * length, splats.quats.copy(), splats.density * unit)

    def motions_mm(self, motions: RigidMotions) -> RigidMotions:
        """The same motions of the object in mm."""
        return RigidMotions(motions.rotation, motions.translation * self.length_mm)


def scene_of(scan: Scan, threads: int, unit: float | None = None) -> Scene:
    """The scan in R2-Gaussian's units. unit: the attenuation that counts as 1, in 1/mm; where it is not known, the
    99.99th percentile of the first volume.

    Raises ReconstructionError where the backprojection is empty.
    """
    volume = fdk(scan.projections, scan.frames, scan.volume, threads, hann=0.0)
    unit = unit or float(np.percentile(volume, _DENSEST))
    if not unit > 0:
        raise ReconstructionError(
            "the first backprojection is empty: got no voxel above zero, expected an object inside the "
            "volume; try a larger volume, or check the sign and kind of the projections"
        )
    length = float(scan.volume.half_extent_mm().max())
    frames, grid = scan.frames, scan.volume
    return Scene(
        length_mm=length,
        unit=unit,
        frames=replace(
            frames,
            source=frames.source / length if frames.beam == "cone" else frames.source,
            detector_center=frames.detector_center / length,
            u=frames.u / length,
            v=frames.v / length,
        ),
        images=np.ascontiguousarray(scan.projections * np.float32(1 / (unit * length)), np.float32),
        mask=None if scan.bad_pixels is None else np.ascontiguousarray(~scan.bad_pixels, np.float32),
        grid=VolumeGrid(
            grid.shape,
            (grid.voxel_mm[0] / length, grid.voxel_mm[1] / length, grid.voxel_mm[2] / length),
            (grid.center_mm[0] / length, grid.center_mm[1] / length, grid.center_mm[2] / length),
        ),
        volume=volume / np.float32(unit),
    )
