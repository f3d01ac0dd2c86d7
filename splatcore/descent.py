"""Adam on the splats of one resolution level: one view a step, all arithmetic in the core."""

from __future__ import annotations

import copy
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splatcore import _native
from splatcore.errors import ReconstructionError
from splatcore.geometry import Array
from splatcore.planar import Plane
from splatcore.splats import Floats, Splats

_REMADE = ("renderer", "gradient")  # scratch: nothing in them outlasts a step


@dataclass(frozen=True)
class Rates:
    """Adam step sizes at the start of a level; all fall exponentially to `end` times that."""

    mean: float = 0.03  # voxels of the level's grid
    log_scale: float = 0.02
    quat: float = 0.0015
    density: float = 0.02  # of the raw parameter, density = unit * softplus(raw)
    end: float = 0.1

    def times(self, factor: float) -> Rates:
        """All rates at the start by a factor; they fall by as much as before."""
        return Rates(self.mean * factor, self.log_scale * factor, self.quat * factor, self.density * factor, self.end)


def require_finite(loss: float, where: str, step: int) -> None:
    """Raises ReconstructionError for a loss that is NaN or infinite: nothing good comes after it."""
    if not np.isfinite(loss):
        raise ReconstructionError(f"the loss became {loss} {where}, step {step}; a bug, please report it")


class Descent:
    """Splats under optimisation. `splats` shares memory with the live parameters."""

    def __init__(
        self,
        splats: Splats,
        rows: int,
        cols: int,
        *,
        voxel_mm: float,
        density_unit: float,
        steps: int,
        rates: Rates,
        huber: float,
        dssim: float,
        data_range: float,
        threads: int,
        scale_limits: tuple[float, float] | None = None,
        plane: Plane | None = None,
    ) -> None:
        """scale_limits: the smallest and largest standard deviation, mm; 0.3 and 20 voxels where left out.
        plane: where all splats stay, of a line detector."""
        self._rows, self._cols = rows, cols
        self.renderer = _native.Renderer32(rows, cols, threads)
        self._limits = scale_limits or (0.3 * voxel_mm, 20 * voxel_mm)
        self._unit, self._steps, self._rates, self._voxel = density_unit, max(steps, 1), rates, voxel_mm
        self._huber, self._dssim, self._range, self.threads = huber, dssim, data_range, threads
        self._plane = plane
        self._count = self._age = 0  # steps since the rates began to fall, since the moments were zero
        self._first = np.zeros(11 * len(splats), np.float32)
        self._second = np.zeros(11 * len(splats), np.float32)
        self.gradient = splats.zeros_like()  # dL/dsplats of the last `differentiate`
        self.replace(splats)

    @property
    def mean_share(self) -> float:
        """What the mean loss counts, beside D-SSIM."""
        return 1 - self._dssim

    def replace(self, splats: Splats) -> None:
        """Go on from these splats (moved by a gauge), keeping the moments."""
        self.splats = Splats(*(np.ascontiguousarray(a, np.float32).copy() for a in splats.arrays()))
        self._log_scales = np.log(self.splats.scales)
        relative = np.maximum(self.splats.density / self._unit, 1e-6)
        self._raw: Floats = np.where(relative > 20, relative, np.log(np.expm1(np.minimum(relative, 20)))).astype(
            np.float32
        )

    def repopulate(self, splats: Splats, parent: NDArray[np.intp]) -> None:
        """Go on from a changed population. parent [len(splats)]: the present row whose moments a splat keeps; -1 for
        a new one, whose moments are zero. Where all are new it is as at the first step."""
        kept = parent >= 0
        self._age = self._age if kept.any() else 0
        old, new = len(self.splats), len(splats)
        for name in ("_first", "_second"):
            before, after = getattr(self, name), np.zeros(11 * new, np.float32)
            start = 0
            for width in (3, 3, 4, 1):  # as the core lays them out: means, scales, quats, density
                rows = before[start * old : (start + width) * old].reshape(old, width)
                after[start * new : (start + width) * new].reshape(new, width)[kept] = rows[parent[kept]]
                start += width
            setattr(self, name, after)
        self.gradient = splats.zeros_like()
        self.replace(splats)

    def branch(self, steps: int, rates: Rates, huber: float, dssim: float = 0.0) -> Descent:
        """Another descent from the present state, with a copy of the moments. The rates fall over `steps`.
        dssim: the least weight of D-SSIM."""
        other = copy.copy(self)
        other._dssim = max(self._dssim, dssim)
        other._steps, other._rates, other._huber, other._count = max(steps, 1), rates, huber, 0
        other._first, other._second = self._first.copy(), self._second.copy()
        if other._dssim > self._dssim:  # what Adam remembers are gradients of a mean loss that counted more
            less = np.float32(other.mean_share / self.mean_share)
            other._first *= less
            other._second *= less**2
        other.gradient = self.splats.zeros_like()
        other.replace(self.splats)
        return other

    def on_detector(self, rows: int, cols: int, voxel_mm: float, scale_limits: tuple[float, float]) -> Descent:
        """Another descent from the present state, on images of other pixels and with the lengths of other voxels."""
        other = self.branch(self._steps, self._rates, self._huber)
        other._rows, other._cols, other._voxel, other._limits = rows, cols, voxel_mm, scale_limits
        other.renderer = _native.Renderer32(rows, cols, self.threads)
        return other

    def state(self) -> dict[str, Any]:
        """All that `from_state` needs to go on with the same bits."""
        return {name: value for name, value in vars(self).items() if name not in _REMADE}

    @classmethod
    def from_state(cls, state: dict[str, Any]) -> Descent:
        other = cls.__new__(cls)
        other.load(state)
        return other

    def load(self, state: dict[str, Any]) -> None:
        """Become what `state` is of."""
        vars(self).update(state)
        self.renderer = _native.Renderer32(self._rows, self._cols, self.threads)
        self.gradient = self.splats.zeros_like()

    def step(self, frame: Array, cone: bool, target: Floats, mask: Floats | None) -> float:
        """One Adam step on one view. Returns the loss before it."""
        loss = self.differentiate(frame, cone, target, mask)
        self.update()
        return loss

    def differentiate(
        self, frame: Array, cone: bool, target: Floats, mask: Floats | None, v_motion: Array | None = None
    ) -> float:
        """The loss of one view. Overwrites `gradient`, and v_motion [6] (omega rad, tau mm), with its derivatives."""
        loss: float = self.renderer.loss_vjp(
            frame, cone, *self.splats.arrays(), target, mask, self._huber, self._dssim, self._range,
            *self.gradient.arrays(), v_motion,
        )  # fmt: skip
        return loss

    def update(self) -> None:
        """One Adam step along `gradient`."""
        s, g = self.splats, self.gradient
        decay = self._rates.end ** (self._count / self._steps)
        self._count, self._age = self._count + 1, self._age + 1
        _native.adam(
            s.means, self._log_scales, s.quats, self._raw, s.scales, s.density, self._first, self._second, *g.arrays(),
            self._rates.mean * self._voxel * decay, self._rates.log_scale * decay, self._rates.quat * decay,
            self._rates.density * decay, *self._limits, self._unit, self._age, self.threads,
        )  # fmt: skip
        if self._plane:
            self._plane.flatten(s.means)
