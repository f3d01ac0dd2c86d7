"""R2-Gaussian's adaptive control: where the images pull hard on a splat there are to be more of them.

Splats whose gradient on the screen is large are cloned (small ones) or split (large ones); faint ones and those
that left the volume are dropped. Lengths and densities are those of `splatcore.scene`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splatcore.geometry import Array
from splatcore.grid import VolumeGrid
from splatcore.splats import Floats, Splats

_SHRINK = 1.6  # of the scales, at a split in two


@dataclass(frozen=True)
class Rules:
    """R2-Gaussian's thresholds (its defaults)."""

    gradient: float = 5e-5  # mean length of dL/d(screen position), the detector being 2 x 2
    large: float = 0.2  # standard deviation from which a splat is split: a tenth of the volume's width
    faintest: float = 1e-5  # density
    most: int = 500_000  # splats beyond which there is no densification


class ScreenGradient:
    """The mean over views of how hard the images pull on each splat across the rays.

    A mean moved by q2 u goes one column along, q2 being its share of the way from source to detector, and stays at
    that depth. So dL/dcolumn = q2 (u . dL/dmean), and half the detector's width is the unit of the threshold.
    """

    def __init__(self, count: int, rows: int, cols: int, cone: bool) -> None:
        self._half = np.array([[cols / 2], [rows / 2]])
        self._cone = cone
        self._sum = np.zeros(count, np.float32)
        self._seen = np.zeros(count, np.int32)

    def add(self, frame: Array, means: Floats, v_means: Floats) -> None:
        """One view's share. frame [4, 3]: source (or ray), detector centre, u, v."""
        across = (frame[2:] * self._half).T.astype(np.float32)  # [3, 2]
        pull = v_means @ across
        length = np.sqrt(pull[:, 0] * pull[:, 0] + pull[:, 1] * pull[:, 1])
        if self._cone:
            normal = np.cross(frame[2], frame[3])
            normal /= normal @ (frame[1] - frame[0])
            length *= np.abs(means @ normal.astype(np.float32) - np.float32(normal @ frame[0]))
        self._sum += length
        self._seen += length > 0

    def state(self) -> dict[str, Any]:
        """For a checkpoint."""
        return {"sum": self._sum, "seen": self._seen}

    def load(self, state: dict[str, Any]) -> None:
        self._sum, self._seen = state["sum"], state["seen"]

    def mean(self) -> Floats:
        """Over the views that showed the splat. [n]"""
        return np.asarray(self._sum / np.maximum(self._seen, 1), np.float32)


def densify(
    splats: Splats, gradient: Floats, rules: Rules, grid: VolumeGrid, rng: np.random.Generator
) -> tuple[Splats, NDArray[np.intp]]:
    """The population after cloning, splitting and pruning, and of every splat the row of `splats` that it continues,
    -1 for a new one.

    A clone lies where its original does, each with half the density. A splat is split into two, drawn from its
    own normal distribution, 1.6 times smaller and half as dense: unlike cloning this does not keep the integral.
    """
    hard = gradient >= rules.gradient
    large = splats.scales.max(axis=1) > rules.large
    cloned, divided = np.flatnonzero(hard & ~large), np.flatnonzero(hard & large)
    density = splats.density.copy()
    density[cloned] *= 0.5
    stay = np.flatnonzero(~(hard & large))
    halves = np.repeat(divided, 2)
    scales = splats.scales[halves]
    drawn = np.einsum("nij,nj->ni", _rotations(splats.quats[halves]), rng.normal(0, 1, scales.shape) * scales)
    row = np.concatenate([stay, cloned, halves])
    split = np.arange(len(row)) >= len(stay) + len(cloned)
    parent = np.where(np.arange(len(row)) < len(stay), row, -1)
    means, new_scales, new_density = splats.means[row], splats.scales[row], density[row]
    means[split] += drawn.astype(np.float32)
    new_scales[split] /= np.float32(_SHRINK)
    new_density[split] *= 0.5
    keep = (new_density >= rules.faintest) & _inside(means, grid)
    changed = Splats(means[keep], new_scales[keep], splats.quats[row][keep], new_density[keep])
    return changed, parent[keep]


def _inside(means: Floats, grid: VolumeGrid) -> NDArray[np.bool_]:
    inside: NDArray[np.bool_] = (np.abs(means - np.array(grid.center_mm)) <= grid.half_extent_mm()).all(axis=1)
    return inside


def _rotations(quats: Floats) -> Array:
    """R(q / |q|): a splat's own axes are its columns. [n, 4] w x y z -> [n, 3, 3]"""
    q = quats.astype(np.float64)
    w, x, y, z = (q / np.linalg.norm(q, axis=1, keepdims=True)).T
    entries = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return np.stack(entries, axis=1).reshape(-1, 3, 3)
