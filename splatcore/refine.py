"""The last stage of a reconstruction: the poses rest, the volume is refined alone.

While poses move, the splats must follow the images and nothing else: a prior on the volume would bend the poses to
it. Once they rest, the rates rise again and two things change. The loss becomes quadratic within the noise, which
averages noise better than L1 does. And the volume may be asked for little total variation: an object of few sharp
materials gains decibels by it, a smooth one loses. Views left out for a while say which it is.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from splatcore.descent import Descent, Rates, require_finite
from splatcore.geometry import Array, Frames
from splatcore.lowpass import NORMAL
from splatcore.pyramid import Level
from splatcore.splats import Floats
from splatcore.trial import Indices
from splatcore.variation import Variation

WEIGHTS = (0.0, 0.02, 0.05)  # of the total variation beside the mean loss; each is tried if the one before won
_UNSEEN_WEIGHT = 0.02  # where no view can be left out: so few views need a prior
_FORGET, _TRIAL_STEPS, _RESTING = 900, 400, 600
_PLAIN = 0.5  # of the stage's steps, where the images hold enough to go on without a prior: more follow the noise
_SURE = 2.0  # standard errors of the mean difference, over the views left out, by which a weight must win
_EVERY = 2  # steps of Adam to one of the variation, which is twice as strong then
_REST = 0.15  # rates at which splats come to rest, of those at the beginning of a level
_HIGH = 0.9  # to which they rise again
_CORNER = 1.345  # standard deviations: Huber's corner that is 95 % efficient on normal noise (Huber 1964)

FORGETTING = Rates(end=_REST)  # views left out


@dataclass(frozen=True)
class Weighing:
    """How strong the variation is to be, what it rests on, and the descent to go on from."""

    weight: float
    start: Descent = field(repr=False)
    further: bool = True  # whether to go on at high rates, or to come to rest
    residuals: tuple[tuple[float, float], ...] = ()  # weight, rms residual of the views left out
    views: int = 0  # left out

    def finding(self) -> dict[str, Any]:
        """For the report (`splatcore.report`)."""
        if not self.residuals:
            text = f"Total variation counted with weight {self.weight:g}; no view could be left out to choose it."
        else:
            plain, best = self.residuals[0][1], dict(self.residuals)[self.weight]
            gain = f"{1 - best / plain:.2%} better than without" if self.weight else "not clearly better with more"
            text = f"Total variation counted with weight {self.weight:g}: views left out were predicted {gain}."
            if not self.further:
                text += " Going on without it would have followed the noise, so the volume came to rest early."
        evidence = {f"residual_at_{weight:g}": rms for weight, rms in self.residuals}
        return {
            "name": "smoothness of the volume", "severity": "ok", "text": text,
            "evidence": {"weight": self.weight, "held_out_views": self.views, "further": self.further, **evidence},
        }  # fmt: skip


class Refinement:
    """Adam on the volume alone."""

    def __init__(self, descent: Descent, here: Level, views: Indices, weight: float, rng: np.random.Generator) -> None:
        """descent: whose splats are moved; views: indices of those to draw."""
        self.descent, self._here, self._views, self._rng = descent, here, views, rng
        half = float(here.grid.half_extent_mm().max())
        self._variation = Variation(here.grid, _EVERY * weight * half, descent.threads) if weight else None
        self.step = 0
        self._order: list[int] = []  # views still to be drawn in this epoch
        self._loss, self._drawn = 0.0, 0  # of this epoch; its views

    def run(self, frames: Frames, steps: int, book: Book | None = None) -> Generator[float, None, None]:
        """Until `step` is `steps`. Yields after every epoch (each view once, in random order) its mean loss.

        book: of an interrupted run goes on from there, and is told of every step."""
        packed, cone, here = frames.packed(), frames.beam == "cone", self._here
        if book:
            book.enter(self)
        while self.step < steps:
            if not self._order:
                self._order = self._rng.permutation(self._views)[: steps - self.step].tolist()
                self._loss, self._drawn = 0.0, len(self._order)
            view = self._order.pop(0)
            self._loss += self.descent.differentiate(packed[view], cone, here.images[view], here.mask)
            self.step += 1
            if self._variation and self.step % _EVERY == 0:
                self._variation.add_gradient(self.descent.splats, self.descent.gradient, self._rng)
            self.descent.update()
            if not self._order:
                require_finite(self._loss, "in the last stage", self.step)
                yield self._loss / self._drawn
            if book:
                book.pause()

    def state(self) -> dict[str, Any]:
        """All that `load` needs to go on with the same bits."""
        kept = {name: getattr(self, name) for name in ("step", "_order", "_loss", "_drawn")}
        return {**kept, "descent": self.descent.state(), "rng": self._rng.bit_generator.state}

    def load(self, state: dict[str, Any]) -> None:
        """Become what `state` is of, the descent in place: others hold it."""
        for name in ("step", "_order", "_loss", "_drawn"):
            setattr(self, name, state[name])
        self.descent.load(state["descent"])
        self._rng.bit_generator.state = state["rng"]


class Book:
    """The refinements of a stage in the order in which they ran, for a checkpoint. A stage that is played again with
    the states of an earlier run passes over what was done then: each refinement finds itself where it was."""

    def __init__(self, pause: Callable[[], None], earlier: Sequence[dict[str, Any]] = ()) -> None:
        self.pause = pause
        self._earlier, self._entered = earlier, list[Refinement]()

    def enter(self, refinement: Refinement) -> None:
        if len(self._entered) < len(self._earlier):
            refinement.load(self._earlier[len(self._entered)])
        self._entered.append(refinement)

    def state(self) -> list[dict[str, Any]]:
        return [refinement.state() for refinement in self._entered]


def weigh(
    descent: Descent, here: Level, frames: Frames, held: Indices, seed: int, book: Book | None = None
) -> Generator[float, None, Weighing]:
    """The weight of the variation that best predicts views (indices) left out. Yields losses.

    First the splats forget those views: rates rise, the other views are drawn. Then short branches, one for each
    weight, come to rest. Where no weight helps, another branch first forgets for as long again: does going on help?"""
    if not len(held):
        return Weighing(_UNSEEN_WEIGHT, descent)
    kept = np.setdiff1d(np.arange(len(frames)), held)
    corner = _noise(descent, here, frames)

    def unseen(start: Descent, weight: float) -> Generator[float, None, Array]:
        """Mean squared residuals of the views left out, once the splats have come to rest."""
        branch = start.branch(_TRIAL_STEPS, FORGETTING.times(_REST), corner)
        yield from Refinement(branch, here, kept, weight, np.random.default_rng(seed)).run(frames, _TRIAL_STEPS, book)
        return np.array([r @ r / r.size for r in _residuals(branch, here, frames, held)])

    def forget(start: Descent, seed: int) -> Generator[float, None, Descent]:
        branch = start.branch(_FORGET, FORGETTING, corner)
        yield from Refinement(branch, here, kept, 0.0, np.random.default_rng(seed)).run(frames, _FORGET, book)
        return branch

    forgetful = yield from forget(descent, seed)
    found: list[tuple[float, float]] = []
    best, least = 0.0, np.zeros(0)
    for weight in WEIGHTS:
        missed = yield from unseen(forgetful, weight)
        found.append((weight, float(np.sqrt(missed.mean()))))
        if len(found) > 1 and not _clearly_less(missed, least):
            break
        best, least = weight, missed
    if best:
        return Weighing(best, forgetful, True, tuple(found), len(held))
    later = yield from unseen((yield from forget(forgetful, seed + 1)), 0.0)
    return Weighing(best, descent, _clearly_less(later, least), tuple(found), len(held))


def _clearly_less(one: Array, other: Array) -> bool:
    """Whether `one` is less than `other` in the mean over views by more than chance."""
    gain = other - one
    return float(gain.mean()) > _SURE * float(gain.std(ddof=1)) / float(np.sqrt(len(gain)))


def refine(
    weighing: Weighing, here: Level, frames: Frames, steps: int, rng: np.random.Generator
) -> tuple[Refinement, int]:
    """The refinement with all views, yet to be run, and its number of steps: `steps` at most."""
    rates = Rates().times(_HIGH)
    if not weighing.further:
        rates, steps = FORGETTING.times(_REST), min(steps, _RESTING)
    elif not weighing.weight:
        steps = int(_PLAIN * steps)
    branch = weighing.start.branch(steps, rates, _noise(weighing.start, here, frames))
    return Refinement(branch, here, np.arange(len(frames)), weighing.weight, rng), steps


def _noise(descent: Descent, here: Level, frames: Frames) -> float:
    """Huber's corner for the residual of a few views, taken for noise. Line integral."""
    views = np.arange(0, len(frames), max(1, len(frames) // 8))
    size = np.mean([np.abs(r).mean() for r in _residuals(descent, here, frames, views)])
    return max(_CORNER * NORMAL * float(size), 1e-6 * float(here.images.max()))


def _residuals(descent: Descent, here: Level, frames: Frames, views: Indices) -> Generator[Floats, None, None]:
    """The residuals of the good pixels of each view. [pixels]"""
    image = np.empty((frames.rows, frames.cols), np.float32)
    good = np.ones(image.shape, bool) if here.mask is None else here.mask > 0
    packed = frames.packed()
    for view in views:
        descent.renderer.render(packed[view], frames.beam == "cone", *descent.splats.arrays(), image)
        yield (image - here.images[view])[good]
