"""How far views scatter about nominal, judged from the poses themselves (empirical Bayes): the prior's width.

A scanner's stated tolerance, or a guess where none is stated, is wide. Where views move by little, the poses found say
so: each is its view's motion plus an error of known covariance, and the width of the motions is what the likelihood
of all views together leaves open. Taken as the prior of later sweeps it shrinks every pose towards nominal by as much
as its own error deserves.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from splatcore.geometry import Array, RigidMotions
from splatcore.poses import Prior

# Variance of a settled pose found with the volume, over that with the volume known: measured 4.3 to 7.1 on scans with
# right poses (docs/method/gate.md).
_VOLUME_UNKNOWN = 4.0
_CONTRADICTED = 2.0  # drop of the log likelihood: two standard deviations
_COARSE = 1.5  # poses of a coarse level are drawn to nominal themselves: true widths were 1.0 to 1.6 times those found
_WIDTHS = 10.0 ** np.linspace(-3.0, 1.0, 81)  # of the root mean square of the poses


def narrowed(prior: Prior, motions: RigidMotions, information: Array) -> Prior:
    """The widest prior, isotropic in rotation and in translation, that the poses do not contradict; never wider
    than the one given. information [views, 6, 6]: of each pose, the volume taken as known."""
    omega, tau = motions.vectors()
    # In units of the prior, which also bounds what a view does not show at all (a shift along a parallel ray).
    unit = 1 / np.sqrt(prior.precision())
    covariance = unit[:, None] * np.linalg.inv(unit[:, None] * information * unit + np.eye(6)) * unit
    covariance *= _VOLUME_UNKNOWN
    return replace(
        prior,
        rotation=min(prior.rotation, _COARSE * _widest(omega, covariance[:, :3, :3])),
        translation=min(prior.translation, _COARSE * _widest(tau, covariance[:, 3:, 3:])),
    )


def _widest(values: Array, covariance: Array) -> float:
    """The largest width t at which values ~ N(0, t^2 + covariance) are not much less likely than at the best t."""
    size = np.sqrt((values**2).mean())
    if not size > 0:
        return np.inf
    eigenvalues, axes = np.linalg.eigh(covariance)
    squares = np.einsum("vij,vi->vj", axes, values) ** 2
    widths = size * _WIDTHS
    variance = np.maximum(eigenvalues, 0) + widths[:, None, None] ** 2
    likelihood = -0.5 * (np.log(variance) + squares / variance).sum(axis=(1, 2))
    return float(widths[np.flatnonzero(likelihood > likelihood.max() - _CONTRADICTED)[-1]])
