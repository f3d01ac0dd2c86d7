"""What a run has to do, how much of it is done, and its clock, which stands still while the run is interrupted."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from splatcore.options import Options
from splatcore.pyramid import factors
from splatcore.scan import Scan

# Adam steps at each binning factor. Coarse steps cost a hundredth of fine ones.
_STEPS = {8: 600, 4: 750, 2: 1200, 1: 2500}
_REFINING, _REFINING_FINE = 6000, 4500  # steps of the last stage, poses at rest; where a step takes long
_REFINING_EPOCHS = 100  # at most
FINE_VOXELS = 1.5 * 128**3
_MOST_EPOCHS = 200
_QUALITY = {"preview": 1.0, "normal": 1.0, "fine": 1.5}
_FINEST = {"preview": 2, "normal": 1, "fine": 1}


@dataclass(frozen=True)
class Stage:
    """One part of a run."""

    kind: str  # "level", "gate" or "refine"
    factor: int  # binning that it works at


@dataclass(frozen=True)
class Work:
    """What a level is expected to cost, in splat-steps."""

    steps: int
    splats: int

    @property
    def cost(self) -> float:
        return self.steps * (self.splats + 500)


class Schedule:
    """The stages of a run and their work: splats grow with the detail there is to see."""

    def __init__(self, scan: Scan, options: Options) -> None:
        assert options.splats is not None
        scales = factors(scan, _FINEST[options.quality])
        self.finest, self.coarsest, self.levels = scales[-1], scales[0], len(scales)
        quality, most = _QUALITY[options.quality], _MOST_EPOCHS * len(scan.frames)
        self._works: dict[int, Work] = {}
        for factor in scales:
            steps = int(min(_STEPS[factor], most) * quality)
            self._works[factor] = Work(steps, max(min(1_500, options.splats), int(options.splats / factor**1.5)))
        self._refining = Work(0, 0)
        if options.quality != "preview":
            steps = _REFINING_FINE if scan.volume.voxels > FINE_VOXELS else _REFINING
            steps = min(steps, _REFINING_EPOCHS * len(scan.frames))
            self._refining = Work(int(steps * quality), self._works[self.finest].splats)
        self.stages = [Stage("level", factor) for factor in scales]
        if len(scales) > 1:
            self.stages.insert(len(scales) - 1, Stage("gate", scales[-2]))
        if self.refines:
            self.stages.append(Stage("refine", self.finest))

    @property
    def refines(self) -> bool:
        """Whether there is a last stage with the poses at rest."""
        return self._refining.steps > 0

    def work(self, stage: Stage) -> Work:
        if stage.kind == "gate":
            return Work(0, 0)
        return self._refining if stage.kind == "refine" else self._works[stage.factor]

    def fraction(self, stage: int, step: int) -> float:
        """The share of the run that is done after so many steps of stage number `stage`."""
        costs = [self.work(each).cost for each in self.stages]
        now = self.work(self.stages[stage])
        under_way = now.cost * step / now.steps if now.steps else 0.0
        return 0.9 * (sum(costs[:stage]) + under_way) / sum(costs)


class Clock:
    """Seconds that a run has been at work, those before an interruption included."""

    def __init__(self) -> None:
        self.began = time.monotonic()  # or earlier by what went before
        self.timings: dict[str, float] = {}  # seconds by stage
        self._now: tuple[str, float] | None = None  # the stage under way, and since when

    @property
    def seconds(self) -> float:
        return time.monotonic() - self.began

    @contextmanager
    def timed(self, name: str) -> Iterator[None]:
        """Counts what is spent inside towards a stage, in several parts if it was interrupted."""
        self._now = name, time.monotonic()
        try:
            yield
        finally:
            self.timings, self._now = self._so_far(), None

    def state(self) -> dict[str, Any]:
        return {"seconds": self.seconds, "timings": self._so_far()}

    def go_on(self, state: dict[str, Any]) -> None:
        """From where an interrupted run was."""
        self.began, self.timings = time.monotonic() - state["seconds"], state["timings"]

    def _so_far(self) -> dict[str, float]:
        if self._now is None:
            return dict(self.timings)
        name, began = self._now
        return {**self.timings, name: self.timings.get(name, 0.0) + time.monotonic() - began}
