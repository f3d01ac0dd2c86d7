"""The last stage of a reconstruction: the poses rest, the volume is refined alone.

While poses move, the splats must follow the images and nothing else: a prior on the volume would bend the poses to
it. Once they rest, the rates rise again and three things change. The loss becomes quadratic within the noise, which
averages noise better than L1 does. A little of D-SSIM joins it, which sees the residual without its slow part. And
the volume may be asked for little total variation: an object of few sharp materials gains decibels by it, a smooth
one loses. Two volumes, of half the views each, say which it is.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from splatcore.descent import Descent, Rates, require_finite
from splatcore.errors import ReconstructionError
from splatcore.geometry import Frames
from splatcore.lowpass import NORMAL
from splatcore.pyramid import Level, coarser
from splatcore.redundancy import orbit
from splatcore.schedule import FINE_VOXELS
from splatcore.splats import Floats
from splatcore.start import first_splats
from splatcore.structure import aligned
from splatcore.trial import FEWEST_VIEWS, Indices
from splatcore.variation import BOX, Variation

WEIGHTS = (0.0, 0.02, 0.05)  # of the total variation beside the mean loss; each is tried if the one before won
_UNSEEN_WEIGHT = 0.02  # where there are too few views to choose: so few need a prior
_HALF_STEPS, _TRIAL_STEPS = 1000, 400  # of a volume of half the views, and of each branch of it
_TRIAL_RATES = 0.3  # at which a branch begins, of those at the beginning of a level
_NOISIER = 2**0.5  # half as many views: so much more noise, and as much more variation to take it away
_PLAIN = 0.5  # of the stage's steps, where the images hold enough to go on without a prior: more follow the noise
_EVERY = 2  # steps of Adam to one of the variation, which is twice as strong then
_BOXES = 4  # of the variation along an edge: in a fine volume each place is visited as often as in a coarse one
_HIGH = 0.9  # rates, of those at the beginning of a level, to which splats rise again
_HALF_RATES = Rates(end=0.15)
_END, _END_FINE = 0.05, 0.1  # times that they fall; less where the steps are too few for so much rest
_CORNER = 1.345  # standard deviations: Huber's corner that is 95 % efficient on normal noise (Huber 1964)
_WIDE = 2.0  # times that, where nothing but noise is left to be robust against
_LIKENESS = 0.07  # D-SSIM beside the mean loss as a share of the largest line integral


@dataclass(frozen=True)
class Weighing:
    """How strong the variation is to be, what it rests on, and the descent to go on from."""

    weight: float
    start: Descent = field(repr=False)
    further: bool = True  # whether to go on at all
    apart: tuple[tuple[float, float], ...] = ()  # weight, rms difference from the other half's volume, 1/mm

    def finding(self) -> dict[str, Any]:
        """For the report (`splatcore.report`)."""
        if not self.apart:
            text = f"Total variation counted with weight {self.weight:g}; too few views showed enough to choose it."
        else:
            plain, best = self.apart[0][1], dict(self.apart)[self.weight]
            gain = f"{1 - best / plain:.1%} nearer by it" if self.weight else "no nearer with more"
            text = f"Total variation counted with weight {self.weight:g}: volumes of half the views each are {gain}."
            if not self.further:
                text += " Going on without it would have followed the noise, so the volume was left as it was."
        evidence = {f"apart_at_{weight:g}": rms for weight, rms in self.apart}
        return {
            "name": "smoothness of the volume", "severity": "ok", "text": text,
            "evidence": {"weight": self.weight, "further": self.further, **evidence},
        }  # fmt: skip


class Refinement:
    """Adam on the volume alone."""

    def __init__(self, descent: Descent, here: Level, views: Indices, weight: float, rng: np.random.Generator) -> None:
        """descent: whose splats are moved; views: indices of those to draw."""
        self.descent, self._here, self._views, self._rng = descent, here, views, rng
        half, box = float(here.grid.half_extent_mm().max()), max(BOX, max(here.grid.shape) // _BOXES)
        strength = _EVERY * weight * half * descent.mean_share  # beside the mean loss, whatever else there is
        self._variation = Variation(here.grid, strength, descent.threads, box) if weight else None
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
    descent: Descent, here: Level, frames: Frames, splats: int, seed: int, book: Book | None = None
) -> Generator[float, None, Weighing]:
    """The weight of the variation under which one half of the views comes nearest to the volume of the other half,
    found with so many splats at a level that may be coarser than the descent's. Yields losses.

    Each half's volume is begun anew, so that they have hardly any noise in common. Then short branches, one for each
    weight, come to rest. The other half's volume, made without variation, is as wrong as its own noise and streaks
    make it, whatever the weight here; so what is nearest to it is nearest to the truth. Where no weight brings a
    volume nearer, the same is asked of going on."""
    if len(frames) < FEWEST_VIEWS:
        return Weighing(_UNSEEN_WEIGHT, descent)
    known = descent.on_detector(here.nominal.rows, here.nominal.cols, here.voxel_mm, here.scale_limits)
    corner = _noise(known, here, frames)
    order = np.argsort(orbit(frames).angle, kind="stable")  # as they are listed, halves might be arcs
    halves = [order[first::2] for first in (0, 1)]
    grid = coarser(here.grid, 2)  # every eighth voxel is enough to tell

    def run(branch: Descent, half: int, steps: int, weight: float) -> Generator[float, None, Descent]:
        draws = np.random.default_rng([seed, half])
        yield from Refinement(branch, here, halves[half], weight, draws).run(frames, steps, book)
        return branch

    def rest(starts: Sequence[Descent], weight: float) -> Generator[float, None, list[Floats]]:
        volumes = []
        for half, start in enumerate(starts):
            branch = start.branch(_TRIAL_STEPS, _HALF_RATES.times(_TRIAL_RATES), corner)
            branch = yield from run(branch, half, _TRIAL_STEPS, _NOISIER * weight)
            volumes.append(branch.splats.voxelize(grid, descent.threads))
        return volumes

    try:
        anew = [
            _begun_anew(known, here, frames, views, splats, corner, np.random.default_rng([seed, half]))
            for half, views in enumerate(halves)
        ]
    except ReconstructionError:  # every second image may be empty
        return Weighing(_UNSEEN_WEIGHT, descent)
    for half, branch in enumerate(anew):
        yield from run(branch, half, _HALF_STEPS, 0.0)
    plain = yield from rest(anew, 0.0)
    found = [(0.0, _apart(plain, plain))]
    for weight in WEIGHTS[1:]:
        found.append((weight, _apart((yield from rest(anew, weight)), plain)))
        if found[-1][1] >= found[-2][1]:
            break
    best, least = min(found, key=lambda each: each[1])
    if best:
        return Weighing(best, descent, True, tuple(found))
    later = []
    for half, start in enumerate(anew):
        branch = start.branch(_HALF_STEPS, _HALF_RATES, corner)
        later.append((yield from run(branch, half, _HALF_STEPS, 0.0)))
    return Weighing(best, descent, _apart((yield from rest(later, 0.0)), plain) < least, tuple(found))


def _begun_anew(
    descent: Descent, here: Level, frames: Frames, views: Indices, count: int, corner: float, rng: np.random.Generator
) -> Descent:
    """A descent from the first splats that these views alone would have given. Only shapes come from all views."""
    threads, grid = descent.threads, coarser(here.grid, 2)
    splats, _ = first_splats(here.images[views], frames[views], here.grid, count, rng, threads)
    branch = descent.branch(_HALF_STEPS, _HALF_RATES, corner)
    branch.repopulate(
        aligned(splats, descent.splats.voxelize(grid, threads), grid, here.scale_limits[0]), np.full(len(splats), -1)
    )
    return branch


def _apart(volumes: Sequence[Floats], others: Sequence[Floats]) -> float:
    """The distance of the volume of each half from that of the other half. Root mean square, 1/mm."""
    squares = [np.mean((a - b).astype(np.float64) ** 2) for a, b in zip(volumes, reversed(others), strict=True)]
    return float(np.sqrt(np.mean(squares)))


def refine(
    weighing: Weighing, here: Level, frames: Frames, steps: int, rng: np.random.Generator
) -> tuple[Refinement, int]:
    """The refinement with all views, yet to be run, and its number of steps: `steps` at most."""
    if not weighing.weight:
        steps = int(_PLAIN * steps) if weighing.further else 0
    top = float(here.images.max())
    rates = Rates(end=_END_FINE if here.grid.voxels > FINE_VOXELS else _END).times(_HIGH)
    corner = _WIDE * _noise(weighing.start, here, frames)
    branch = weighing.start.branch(steps, rates, corner, _LIKENESS * top / (1 + _LIKENESS * top))
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
