"""A small object with edges, no symmetry and fine parts, and scans of it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from splatcore.scan import Scan, read_scan
from splatcore.simulate import Simulation, simulate


def phantom(edge: int = 40) -> np.ndarray:
    """A cube [z, y, x] of values in [0, 1]: ellipsoids, boxes and beads inside the inscribed cylinder."""
    axis = (np.arange(edge) + 0.5) / edge * 2 - 1
    z, y, x = np.meshgrid(axis, axis, axis, indexing="ij")
    volume = np.zeros((edge,) * 3)
    volume[(x / 0.62) ** 2 + (y / 0.5) ** 2 + (z / 0.75) ** 2 < 1] = 0.45
    volume[(abs(x - 0.2) < 0.15) & (abs(y + 0.1) < 0.22) & (abs(z - 0.25) < 0.2)] = 0.9
    volume[((x + 0.3) / 0.15) ** 2 + ((y - 0.15) / 0.2) ** 2 + ((z + 0.2) / 0.3) ** 2 < 1] = 0.1
    for bx, by, bz in [(0.3, 0.25, -0.4), (-0.1, -0.35, 0.4), (-0.35, 0.1, 0.45), (0.45, -0.1, -0.1), (0.0, 0.3, 0.1)]:
        volume[(x - bx) ** 2 + (y - by) ** 2 + (z - bz) ** 2 < 0.07**2] = 1.0
    return volume.astype(np.float32)


def scan_of(folder: Path, what: Simulation, edge: int = 40) -> Scan:
    """A simulated scan of the phantom, written and read back."""
    simulate(phantom(edge), folder, what, threads=2, name="phantom")
    return read_scan(folder)
