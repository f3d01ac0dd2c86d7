"""Views that are lost: far from their place while the others have found theirs.

A sweep moves all views a little, with the others' needs in mind. A view that began far off lags behind, and what it
shows pulls at the volume from the wrong side. Once the others agree, it stands out: it fits much worse than they do.
Then its pose alone is solved to the end, the volume held (Levenberg 1944, Marquardt 1963): from where it is, and at the
end of a level, if that led nowhere or the view stands out still, from places around nominal; only along directions that
its image shows clearly, for the others follow the errors of a coarse model. What was found counts if the view fits so
much better that it must have been lost.
"""

from __future__ import annotations

import numpy as np

from splatcore.descent import Descent
from splatcore.geometry import RigidMotions
from splatcore.misfit import Fit, Misfit
from splatcore.poses import Normals, Prior, clear_directions
from splatcore.pyramid import Level
from splatcore.splats import Floats
from splatcore.trial import Indices

_STANDS_OUT = 1.5  # times the median residual: by less, noise and the object's sides differ
_FOUND = 0.75  # times its residual before: within its own minimum a view gains less
_FARTHEST = 5.0  # shift, in standard deviations of the prior: an image of nothing fits best with nothing in sight
_AROUND = 2.4  # standard deviations of the prior, about each axis: where else to begin
_STEPS = 40
_DAMPING, _EASED, _TIGHTENED, _STUCK = 1e-3, 0.2, 6.0, 1e6
_SETTLED = 1e-3  # share of the squared residual: a step that gains less is the last


def lost_views(normals: Normals) -> tuple[Indices, float]:
    """Indices of the views whose residual stands out, and the residual above which one does."""
    most = _STANDS_OUT * float(np.median(normals.rms))
    return np.flatnonzero(normals.rms > most), most


def find_again(
    here: Level, descent: Descent, motions: RigidMotions, views: Indices, most: float, prior: Prior, *, around: bool
) -> tuple[RigidMotions, Indices]:
    """The motions with those of the views that were found, and the indices of these.

    here: its nominal frames are those before any view's own motion; views, most: as `lost_views` gives them; around:
    from places around nominal as well where that finds no place or the view stands out still, which takes eight times
    as long."""
    rotation, translation = motions.rotation.copy(), motions.translation.copy()
    found: list[int] = []
    corner = float(np.abs(here.images).max())  # none is an outlier: a view in the wrong place would be all outliers
    turns = _AROUND * prior.rotation * np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)])
    places = RigidMotions.exp(turns, np.zeros_like(turns))
    for view in views:
        misfit = Misfit(here, descent, int(view), prior, corner)
        start = misfit.at(motions[view : view + 1], here.mask)
        end = _descended(misfit, start, here.mask)
        if around and not (_is_found(start, end, prior) and end.rms <= most):
            others = [misfit.at(places[k : k + 1], here.mask) for k in range(len(turns))]
            ends = [end, *(_descended(misfit, other, here.mask) for other in others)]
            end = min(ends, key=lambda fit: (not _is_found(start, fit, prior), fit.loss))
        if _is_found(start, end, prior):
            rotation[view], translation[view] = end.motion.rotation[0], end.motion.translation[0]
            found.append(int(view))
    return RigidMotions(rotation, translation), np.array(found, np.int64)


def _is_found(start: Fit, end: Fit, prior: Prior) -> bool:
    in_sight = np.abs(end.motion.translation).max() < _FARTHEST * prior.translation
    return end.rms < _FOUND * start.rms and bool(in_sight)


def _descended(misfit: Misfit, fit: Fit, mask: Floats | None) -> Fit:
    damping = _DAMPING
    for _ in range(_STEPS):
        trial = misfit.at(misfit.stepped(fit, damping, clear_directions(fit.hessian)), mask)
        if not trial.loss < fit.loss:  # nor where it is no number
            damping *= _TIGHTENED
            if damping > _STUCK:
                break
            continue
        settled = trial.loss > (1 - _SETTLED) * fit.loss
        fit, damping = trial, max(_EASED * damping, _DAMPING)
        if settled:
            break
    return fit
