"""How badly one view fits splats that are held, as a function of the view's pose, and Gauss-Newton on it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from splatcore.descent import Descent
from splatcore.geometry import Array, RigidMotions
from splatcore.poses import Prior, accumulate
from splatcore.pyramid import Level
from splatcore.splats import Floats

_ANYWHERE = np.eye(6)


@dataclass(frozen=True)
class Fit:
    """One view at one pose."""

    motion: RigidMotions  # of this view alone
    hessian: Array  # [6, 6] omega rad, tau mm
    gradient: Array  # [6]
    loss: float  # robust squared residual
    noise: float  # variance of a pixel
    rms: float


class Misfit:
    """The robust squared residual of one view."""

    def __init__(self, here: Level, descent: Descent, view: int, prior: Prior, huber: float) -> None:
        """here: its nominal frames are those before any view's own motion; huber: beyond it squares grow linearly."""
        self._nominal, self._target = here.nominal[view : view + 1], here.images[view : view + 1]
        self._descent, self._huber, self._precision = descent, huber, np.diag(prior.precision())

    def at(self, motion: RigidMotions, mask: Floats | None) -> Fit:
        """mask [rows, cols]: the weights of pixels."""
        frames, descent = motion.correct(self._nominal), self._descent
        normals = accumulate(descent.renderer, descent.splats, frames, self._target, mask, self._huber)
        return Fit(
            motion, normals.rigid[0], normals.gradient[0, :6], max(float(normals.weighted_ss[0]), 1e-30),
            float(normals.noise[0]), float(normals.rms[0]),
        )  # fmt: skip

    def stepped(self, fit: Fit, damping: float, within: Array = _ANYWHERE) -> RigidMotions:
        """The pose after one damped Gauss-Newton step along the columns of `within` [6, n], the prior counted in."""
        system = fit.hessian / fit.noise + self._precision
        system += damping * np.diag(np.diag(system))
        offset = np.concatenate(fit.motion.vectors(), axis=1)[0]
        slope = fit.gradient / fit.noise + self._precision @ offset
        increment = -(within @ np.linalg.solve(within.T @ system @ within, within.T @ slope))[None]
        return fit.motion @ RigidMotions.exp(increment[:, :3], increment[:, 3:])
