"""How the views moved, as a function of time: nothing, one constant motion, a smooth curve.

Poses found view by view carry the noise of one view each. Where the scanner only drifts, a curve through all of them
is nearer the truth. A curve has six components; each is a penalised cubic B-spline of time (P-spline: Eilers and Marx,
Statistical Science 11, 1996), fitted to all poses at once, each weighted by its 6x6 information, so that what one
view does not show (a turn about v against a shift along u) is taken from its neighbours.

Two families of curves. A part of the scanner that drifts moves smoothly in the axes of the *camera*; an object that
drifts on its turntable moves smoothly in the axes of the *turntable*, which is the world here. What is constant in
the camera (a static error of the scanner) belongs to both. Family and smoothness are chosen by generalised
cross-validation.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.interpolate import BSpline

from splatcore.geometry import Array, Frames, RigidMotions

Axes = Literal["camera", "turntable"]

_DEGREE = 3
_MOST_SEGMENTS = 16
_VIEWS_PER_SEGMENT = 3
# The price of a degree of freedom in cross-validation: plain GCV now and then follows the noise (Kim and Gu,
# J. R. Statist. Soc. B 66, 2004, recommend 1.2 to 1.4).
_PRICE = 1.4
_SOFTEST, _STIFFEST = -4, 8  # powers of ten of the penalty, relative to the information of one segment's views
_ROUNDS = 4
_UNSEEN = 1e-13  # share of the best-seen parameter's information (1/rad^2 beside 1/mm^2) below which one is not seen


@dataclass(frozen=True)
class Curve:
    """A fitted motion of all views."""

    axes: Axes | None  # None: one constant motion in the camera's axes
    motions: RigidMotions
    penalties: Array  # [6] of the components, empty for a constant
    freedom: float  # effective number of parameters, trace of the hat matrix
    criterion: float  # generalised cross-validation, of whitened poses; comparable between curves of one fit


def spline_basis(time: Array, segments: int) -> Array:
    """Cubic B-splines on uniform knots over the range of time. [views, segments + 3], rows sum to one.

    Time where all views stand at one moment is a single constant column."""
    low, high = float(np.min(time)), float(np.max(time))
    if not high > low:
        return np.ones((len(time), 1))
    step = (high - low) / segments
    knots = low + step * np.arange(-_DEGREE, segments + _DEGREE + 1)
    inside = np.clip(time, knots[_DEGREE], knots[-_DEGREE - 1])
    return np.asarray(BSpline.design_matrix(inside, knots, _DEGREE).toarray(), np.float64)


def constant_motion(nominal: Frames, motions: RigidMotions, information: Array) -> Curve:
    """The one motion in camera axes that is nearest the views' own, each weighted by its information [views, 6, 6]
    (world axes, omega then tau). It holds what a rigid motion can say of static errors."""
    return _fit(nominal, motions, information, None, np.ones((len(nominal), 1)))


def smooth_motion(
    nominal: Frames, motions: RigidMotions, information: Array, time: Array | None = None, like: Curve | None = None
) -> Curve:
    """The smooth curve nearest the views' own motions. information [views, 6, 6] as in `constant_motion`; a view with
    none is predicted from the others. time [views]: page order where None. like: axes and penalties of an earlier
    curve are taken over, which is a hundred times as fast."""
    moment = np.arange(len(nominal), dtype=np.float64) if time is None else np.asarray(time, np.float64)
    segments = int(np.clip(len(nominal) // _VIEWS_PER_SEGMENT, 1, _MOST_SEGMENTS))
    basis = spline_basis(moment, segments)
    if like is not None:
        return _fit(nominal, motions, information, like.axes, basis, like.penalties)
    curves = [_fit(nominal, motions, information, axes, basis) for axes in ("camera", "turntable")]
    return min(curves, key=lambda curve: curve.criterion)


def _fit(
    nominal: Frames,
    motions: RigidMotions,
    information: Array,
    axes: Axes | None,
    basis: Array,
    penalties: Array | None = None,
) -> Curve:
    """Weighted, penalised least squares. Penalties that are not given are chosen by cross-validation."""
    design = _design(nominal, axes, basis)  # [views, 6, parameters]
    poses = np.concatenate(motions.vectors(), axis=1)
    weighted = information @ design
    normal = np.einsum("vij,vik->jk", design, weighted, optimize=True)
    right = np.einsum("vij,vi->j", weighted, poses)
    total = float(np.einsum("vi,vij,vj->", poses, information, poses))
    seen = 6 * int(np.count_nonzero(np.trace(information, axis1=1, axis2=2) > 0))
    # Components differ in unit and in how well they are seen: each is scaled to unit information. What no view shows
    # (with a line detector, all that leaves its plane) stays zero.
    diagonal = np.diag(normal)
    seen_at_all = diagonal > _UNSEEN * diagonal.max()
    scale = np.where(seen_at_all, 1 / np.sqrt(np.where(seen_at_all, diagonal, 1.0)), 0.0)
    normal, right = scale[:, None] * normal * scale, scale * right
    roughness = _roughness(axes, basis.shape[1], scale)

    def solve(weights: Array) -> tuple[float, Array, float]:
        system = normal + np.einsum("d,dij->ij", weights, roughness) + 1e-9 * np.eye(len(normal))
        both = np.linalg.solve(system, np.concatenate([right[:, None], normal], axis=1))
        answer, freedom = both[:, 0], float(np.trace(both[:, 1:]))
        misfit = max(total - 2 * answer @ right + answer @ normal @ answer, 1e-12 * total)
        slack = 1 - _PRICE * freedom / max(seen, 1)
        return (misfit / slack**2 if slack > 0 else np.inf), answer, freedom

    chosen = _cross_validated(lambda w: solve(w)[0], len(roughness)) if penalties is None else penalties
    criterion, answer, freedom = solve(chosen)
    curve = np.einsum("vij,j->vi", design, scale * answer)
    return Curve(axes, RigidMotions.exp(curve[:, :3], curve[:, 3:]), chosen, freedom, criterion)


def _cross_validated(criterion: Callable[[Array], float], components: int) -> Array:
    """The penalties of least criterion: one for all first, then each component's own, a decade up or down at a time."""
    if components == 0:
        return np.zeros(0)
    common = [np.full(components, 10.0**decade) for decade in range(_SOFTEST, _STIFFEST + 1)]
    values = [criterion(weights) for weights in common]
    best, weights = min(values), common[int(np.argmin(values))]
    for _ in range(_ROUNDS):
        before = best
        for component in range(components):
            for factor in (10.0, 0.1):
                trial = weights.copy()
                trial[component] *= factor
                while 10.0**_SOFTEST <= trial[component] <= 10.0**_STIFFEST:
                    found = criterion(trial)
                    if found > 0.9999 * best:
                        break
                    best, weights = found, trial.copy()
                    trial[component] *= factor
        if best > 0.999 * before:
            break
    return weights


def _design(nominal: Frames, axes: Axes | None, basis: Array) -> Array:
    """What each parameter does to each view's (omega, tau) in world axes. [views, 6, parameters]: the spline
    coefficients, component by component; then, for a curve in turntable axes, a constant motion in camera axes."""
    views, count = basis.shape
    back = np.zeros((views, 6, 6))  # from camera to world
    back[:, :3, :3] = back[:, 3:, 3:] = np.swapaxes(nominal.axes(), 1, 2)
    if axes == "turntable":
        spline = np.einsum("vb,ij->vijb", basis, np.eye(6)).reshape(views, 6, 6 * count)
        return np.concatenate([spline, back], axis=2)
    return np.einsum("vb,vij->vijb", basis, back).reshape(views, 6, 6 * count)


def _roughness(axes: Axes | None, count: int, scale: Array) -> Array:
    """[components, parameters, parameters]: squared second differences of each component's coefficients, which leave
    a line free of charge. In units of the component's own information, so that one grid of penalties serves all."""
    if axes is None or count < 3:
        return np.zeros((0, len(scale), len(scale)))
    difference = np.diff(np.eye(count), n=2, axis=0)
    roughness = np.zeros((6, len(scale), len(scale)))
    for component in range(6):
        part = slice(component * count, (component + 1) * count)
        own = scale[part] / (np.median(scale[part]) or 1.0)
        roughness[component, part, part] = own[:, None] * (difference.T @ difference) * own
    return roughness
