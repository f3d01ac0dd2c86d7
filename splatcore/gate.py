"""How freely the views may move: not at all, together, along a smooth curve, each for itself. Held-out views decide.

Six numbers a view also fit noise. Whether they are worth having is asked of views that took no part: a short
reconstruction is made from the other views, posed as a model of the motion says; the model predicts the pose of each
held-out view as well. Then that view is set free: six numbers are fitted to one half of its pixels (squares of a
checkerboard) and judged on the other half, and the halves change places. A model stands if freedom predicts the
unseen half no better than the model did. Models are tried from the least free to the freest; the first that stands
is taken (docs/method/gate.md).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from splatcore.geometry import Array, Frames, RigidMotions
from splatcore.lowpass import HUBER, NORMAL
from splatcore.misfit import Fit, Misfit
from splatcore.motionmodel import Curve, constant_motion, smooth_motion
from splatcore.poses import Normals, Prior
from splatcore.pyramid import Level
from splatcore.splats import Floats
from splatcore.trial import Indices, held_out_views, try_frames

Model = Literal["none", "static", "smooth", "full"]
MODELS: tuple[Model, ...] = ("none", "static", "smooth", "full")

_SQUARE = 4  # pixels: neighbours share noise and the model's own error
_STEPS = 2  # Gauss-Newton steps of a view set free
_DAMPING = 1e-3
# A model that would more than double the squared residual of some view is wrong: nothing needs to be tried.
_HOPELESS = 1.0
_WORDS = {
    "none": "the nominal poses",
    "static": "one constant motion of all views",
    "smooth": "a smooth motion over time",
    "full": "a motion of every view for itself",
}


@dataclass(frozen=True)
class Score:
    """How one model of the motion did."""

    model: Model
    harm: float  # what it would add to the squared residual of the view that it fits worst, as a share
    gain: float | None = None  # by which freedom lowers the unseen squared residual, mean log ratio; None: not tried
    error: float | None = None  # of the gain, one standard error over held-out views

    @property
    def stands(self) -> bool:
        return self.gain is not None and self.gain <= 0


@dataclass(frozen=True)
class Decision:
    """The model of the motion, and what it rests on."""

    model: Model
    motions: RigidMotions
    scores: tuple[Score, ...] = ()
    views: int = 0  # held out
    curve: Curve | None = field(default=None, repr=False)
    time: Array | None = field(default=None, repr=False)

    def restrict(self, nominal: Frames, motions: RigidMotions, normals: Normals) -> RigidMotions:
        """The motions of this model that are nearest the views' own, weighted by what each view shows.

        After a Gauss-Newton step of every view this is the Gauss-Newton step of the model: the least-squares fit
        of shared parameters to W-weighted single solutions solves the sum of their normal equations."""
        if self.model == "none":
            return RigidMotions.identity(len(nominal))
        if self.model == "static":
            return constant_motion(nominal, motions, information(normals)).motions
        if self.model == "smooth":
            return smooth_motion(nominal, motions, information(normals), self.time, self.curve).motions
        return motions

    def sentence(self) -> str:
        if not self.scores:
            return "No view could be left out to judge how freely views may move; they moved as the options allow."
        tried = self.scores[-1]
        if tried.stands and tried.gain is not None:
            text = (
                f"Of {self.views} views left out, {_WORDS[self.model]} predicted what was not seen as well as six "
                f"numbers fitted to each, which made it {_change(tried.gain)}; views were given no more freedom."
            )
        elif tried.gain is not None:
            text = (
                f"On {self.views} views left out, six numbers fitted to each made what was not seen "
                f"{_change(tried.gain)} than {_WORDS[tried.model]} did; every view was given its own."
            )
        else:
            text = (
                f"With {_WORDS[tried.model]} some view would keep {1 + tried.harm:.3g} times its squared residual; "
                "every view was given its own motion."
            )
        return text

    def finding(self) -> dict[str, Any]:
        """For the report (`splatcore.report`)."""
        evidence: dict[str, Any] = {"model": self.model, "held_out_views": self.views}
        for score in self.scores:
            evidence[score.model] = {"worst_view_adds": score.harm}
            if score.gain is not None:
                evidence[score.model] |= {"gain_of_freedom": score.gain, "standard_error": score.error}
        if self.curve is not None:
            evidence |= {"smooth_in_axes_of": self.curve.axes, "effective_parameters": self.curve.freedom}
        return {"name": "model of the motion", "severity": "ok", "text": self.sentence(), "evidence": evidence}


def _change(gain: float) -> str:
    return f"{abs(np.expm1(-gain)):.1%} {'worse' if gain < 0 else 'better'}"


def information(normals: Normals) -> Array:
    """Of each view's pose, the volume taken as known. [views, 6, 6]"""
    return np.asarray(normals.rigid / normals.noise[:, None, None], np.float64)


def gate(
    here: Level,
    motions: RigidMotions,
    normals: Normals,
    prior: Prior,
    *,
    most: Model = "full",
    time: Array | None = None,
    seed: int = 0,
    threads: int = 1,
) -> Decision:
    """The least free model of the motion that held-out views do not contradict.

    here: the level to try at; motions: of all views, as found there, with their normal equations; prior: of a view
    that is free; most: the freest model allowed; time [views]: page order where None. With fewer than 16 views
    nothing can be left out, and the motions stay as they are.
    """
    nominal = here.nominal
    held = held_out_views(len(nominal))
    if most == "none" or not len(held):
        return Decision(most, motions)
    known = information(normals)
    unseen = known.copy()
    unseen[held] = 0  # what a model says of a held-out view must not rest on it
    scores: list[Score] = []
    for model in MODELS[: MODELS.index(most)]:
        prediction, _ = _fitted(model, nominal, motions, unseen, time)
        harm = _harm(prediction, motions, normals)
        score = Score(model, harm)
        if harm <= _HOPELESS:
            gains = _gains_of_freedom(here, prediction, prior, _huber(normals), held, seed, threads)
            score = Score(model, harm, float(gains.mean()), float(gains.std(ddof=1) / np.sqrt(len(gains))))
        scores.append(score)
        if score.stands:
            fitted, curve = _fitted(model, nominal, motions, known, time)
            return Decision(model, fitted, tuple(scores), len(held), curve, time)
    fitted, curve = _fitted(most, nominal, motions, known, time)
    return Decision(most, fitted, tuple(scores), len(held), curve, time)


def _fitted(
    model: Model, nominal: Frames, motions: RigidMotions, weights: Array, time: Array | None
) -> tuple[RigidMotions, Curve | None]:
    if model == "none":
        return RigidMotions.identity(len(nominal)), None
    if model == "static":
        return constant_motion(nominal, motions, weights).motions, None
    if model == "smooth":
        curve = smooth_motion(nominal, motions, weights, time)
        return curve.motions, curve
    return motions, None


def _huber(normals: Normals) -> float:
    return HUBER * NORMAL * float(normals.residual_abs.sum() / max(normals.pixels.sum(), 1.0))


def _harm(prediction: RigidMotions, motions: RigidMotions, normals: Normals) -> float:
    """What the model adds to the squared residual of the view that it fits worst, as a share, to second order."""
    away = np.concatenate((prediction @ motions.inverse()).vectors(), axis=1)
    added = np.einsum("vi,vij,vj->v", away, normals.rigid, away)
    return float((added / np.maximum(normals.weighted_ss, 1e-30)).max())


def _gains_of_freedom(
    here: Level, prediction: RigidMotions, prior: Prior, huber: float, held: Indices, seed: int, threads: int
) -> Array:
    """ln(squared residual as predicted / after the view is set free), of pixels that its freedom did not see. [held]

    Robust: squares beyond `huber` grow linearly. Positive where freedom predicts better."""
    kept = np.setdiff1d(np.arange(len(here.nominal)), held)
    trial = try_frames(here, prediction.correct(here.nominal), kept, seed, threads)
    if trial is None:
        return np.full(len(held), np.inf)
    halves = _halves(here)
    gains = []
    for view in held:
        misfit = Misfit(here, trial, int(view), prior, huber)
        start = RigidMotions(prediction.rotation[view : view + 1], prediction.translation[view : view + 1])
        before, after = 0.0, 0.0
        for fitted, unseen in (halves, halves[::-1]):
            before += misfit.at(start, unseen).loss
            after += misfit.at(_freed(misfit, start, fitted).motion, unseen).loss
        gains.append(np.log(before / after))
    return np.array(gains)


def _halves(here: Level) -> tuple[Floats, Floats]:
    """The white and the black squares of a checkerboard, each without the bad pixels. [rows, cols]"""
    row, column = np.indices((here.nominal.rows, here.nominal.cols)) // _SQUARE
    white = ((row + column) % 2).astype(np.float32)
    good = np.float32(1) if here.mask is None else here.mask
    return white * good, (1 - white) * good


def _freed(misfit: Misfit, motion: RigidMotions, mask: Floats) -> Fit:
    """The view after a few Gauss-Newton steps on these pixels: of all poses that were visited that of least loss."""
    best = fit = misfit.at(motion, mask)
    for _ in range(_STEPS):
        fit = misfit.at(misfit.stepped(fit, _DAMPING), mask)
        if fit.loss < best.loss:
            best = fit
    return best
