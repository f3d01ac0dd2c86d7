"""The joint reconstruction: splats and poses together, coarse to fine. Read this file first.

At each resolution: backproject with the poses found so far (FDK), put splats where the volume is not empty,
then alternate. One epoch of Adam on the splats, one view a step, for every sweep of Gauss-Newton over
the poses (splatcore.calibration). After each sweep the freedoms that no projection shows are settled, and the splats
follow.

    events = reconstruct(scan, options)      # a generator of Progress
    for event in events: ...                 # its return value is the Reconstruction

A run may be interrupted at any step and gone on with later: its result has the same bits (splatcore.keeper).
"""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import replace
from typing import Any

import numpy as np

from splatcore import r2
from splatcore.calibration import STATIC_FIRST, Calibration
from splatcore.checkpoint import identity
from splatcore.conclusion import conclude, mark_partial
from splatcore.descent import Descent, Rates, require_finite
from splatcore.errors import OptionsError, ReconstructionError
from splatcore.estimate import default_splats
from splatcore.exposure import finding
from splatcore.gate import Decision, Score
from splatcore.geometry import Frames, RigidMotions
from splatcore.keeper import Concluding, Keeper
from splatcore.machine import threads_allowed
from splatcore.motionmodel import Curve
from splatcore.options import Options
from splatcore.orientation import Orientation, Verdict, oriented, read_as
from splatcore.orientation import finding as orientation_finding
from splatcore.planar import Plane, common_plane
from splatcore.poses import Normals, Prior
from splatcore.progress import Progress
from splatcore.pyramid import Level, coarser, level
from splatcore.reconstruction import Reconstruction
from splatcore.refine import Book, Weighing, refine, weigh
from splatcore.scan import Scan
from splatcore.schedule import FINE_VOXELS, Clock, Schedule, Stage
from splatcore.splats import Splats
from splatcore.start import first_splats
from splatcore.static import Static
from splatcore.structure import aligned

_SETTLE_IN = 0.25  # share of a level's steps before its first pose sweep, at most two epochs
_WAIT = 0.25  # share of a level's steps, but of the coarsest, in which turns that a view hardly shows are left alone
_OFTEN, _SELDOM = 16, 3  # a fine level is swept after each of its first 16 epochs, then after every third
_WORTH_THREADS = 4_000  # splats
_COARSE = Rates(mean=0.05, log_scale=0.01, quat=0.01)  # shapes that give way easily let the object be strained
_JOINT = Rates(end=0.02)  # at the finest level: as long as splats move, poses wander with them
_MOST_SHOWN = 256**3  # voxels of a draft: more take seconds to make and to write
_FAINTEST = 1e-30  # line integral; single precision has no room for the squares of less

# What a checkpoint may hold beside plain values and arrays.
_KINDS = (Curve, Decision, Normals, Orientation, Plane, Prior, Rates, RigidMotions, Score, Splats, Static, Verdict)


def drain(events: Generator[Progress, None, Reconstruction]) -> Reconstruction:
    """Run a reconstruction to its end without looking at its events."""
    while True:
        try:
            next(events)
        except StopIteration as end:
            result: Reconstruction = end.value
            return result


def reconstruct(
    scan: Scan, options: Options | None = None, keeper: Keeper | None = None
) -> Generator[Progress, None, Reconstruction]:
    """Reconstruct a scan. Yields Progress, returns the Reconstruction.

    keeper: keeps the run's state, from which a later call of the same goes on, and may ask it to stop or conclude.

    Raises ReconstructionError where the projections hold nothing to reconstruct, Stopped where that was asked.
    """
    keeper = keeper or Keeper()
    if options is not None and options.method != "splatct":
        return (yield from r2.reconstruct(scan, options, keeper=keeper))
    options = resolved(scan, options or Options())
    assert options.threads is not None
    state, word = keeper.recall(lambda: identity(scan, options), _KINDS)
    verdict: Verdict | None = None if state is None else state["verdict"]
    if verdict is None:
        trying = "find out how the scanner turns and how its images are stored"
        yield Progress("start", 0.0, f"{word}; {trying}" if word else trying)
        word = ""  # has been said
        scan, verdict = oriented(scan, options, options.threads)
    else:
        scan = read_as(scan, options, verdict.found)
    run = _Run(scan, options, verdict, keeper)
    if state is not None:
        run.go_on(state)
    facts = f"{len(scan.frames)} views of {scan.frames.rows} x {scan.frames.cols}"
    yield run.progress("start", f"{word}; {facts}" if word else facts)
    try:
        yield from run.stages()
    except Concluding:
        yield run.progress("diagnose", "asked to end: making the best of what there is")
        return (yield from run.finish(whole=False))
    return (yield from run.finish())


def resolved(scan: Scan, options: Options) -> Options:
    """Options with every default filled in: the threads this process may use, splats by the volume's size.

    Raises OptionsError where the detector cannot show what is to be calibrated.
    """
    if options.calibrate == "full" and scan.frames.rows * scan.frames.cols < 2:
        raise OptionsError(
            "calibrate: got full for a detector of 1 x 1 pixels, expected at least two: a single ray does not show how "
            "a view moves; use none"
        )
    threads = options.threads or threads_allowed()
    splats = options.splats or default_splats(scan.volume.voxels)
    return replace(options, threads=threads, splats=splats)


class _Run:
    """One reconstruction under way."""

    def __init__(self, scan: Scan, options: Options, orientation: Verdict, keeper: Keeper) -> None:
        self._scan, self._options, self._orientation, self._keeper = scan, options, orientation, keeper
        assert options.threads is not None
        self._threads = options.threads
        self._clock, self._schedule = Clock(), Schedule(scan, options)
        self._calibration = Calibration(scan, options)
        self._stage = 0  # number of the present one
        self._rng = self._draws(self._stage)
        self._here: Level | None = None  # what it works at, as the scan has it
        self._descent: Descent | None = None  # of the finest level so far
        self._under_way: dict[str, Any] = {}  # of the present level: step, views left in this epoch, loss
        self._weighing: Weighing | None = None
        self._book: Book | None = None  # of the last stage
        self._earlier: list[dict[str, Any]] = []  # what its book held in an interrupted run
        self._fraction = 0.0

    def state(self) -> dict[str, Any]:
        """All that `go_on` needs, between any two steps."""
        weighed = None
        if self._weighing is not None:
            weighed = {name: getattr(self._weighing, name) for name in ("weight", "further", "apart")}
        return {
            "verdict": self._orientation, "stage": self._stage, "fraction": self._fraction,
            "clock": self._clock.state(),
            "rng": self._rng.bit_generator.state, "calibration": self._calibration.state(),
            "under_way": self._under_way, "weighed": weighed, "book": self._book.state() if self._book else [],
            # The refinement with all views, once there is one, has it in its book.
            "descent": None if weighed and self._book else self._descent and self._descent.state(),
        }  # fmt: skip

    def go_on(self, state: dict[str, Any]) -> None:
        """From where an interrupted run was."""
        self._stage, self._fraction, self._under_way = state["stage"], state["fraction"], state["under_way"]
        self._earlier = state["book"]
        self._rng.bit_generator.state = state["rng"]
        self._clock.go_on(state["clock"])
        self._calibration.go_on(state["calibration"])
        if state["descent"] is not None:
            self._descent = Descent.from_state(state["descent"])
        if state["weighed"] is not None:
            if self._descent is None:
                self._descent = Descent.from_state(self._earlier[0]["descent"])
            self._weighing = Weighing(start=self._descent, **state["weighed"])

    def _draws(self, stage: int) -> np.random.Generator:
        """Of each stage its own, so that what came before it decides nothing but where it begins."""
        return np.random.default_rng([self._options.seed, stage])

    def progress(self, stage: str, message: str, **facts: object) -> Progress:
        return Progress(stage, self._fraction, message, self._clock.seconds, **facts)  # type: ignore[arg-type]

    def stages(self) -> Generator[Progress, None, None]:
        """All that are still to be done."""
        parts = {"level": self._level, "gate": self._gate, "refine": self._refine}
        while self._stage < len(self._schedule.stages):
            stage = self._schedule.stages[self._stage]
            if self._here is None or self._here.factor != stage.factor:
                self._here = level(self._scan, stage.factor)
            with self._clock.timed(f"binning_{stage.factor}" if stage.kind == "level" else stage.kind):
                yield from parts[stage.kind](stage, self._here)
            self._stage, self._under_way, self._book = self._stage + 1, {}, None
            self._rng = self._draws(self._stage)
            self._keeper.pause(self.state, stage_ends=True)
            if stage.kind == "level" and self._stage < len(self._schedule.stages):
                yield from self._show(self._here)

    def _show(self, here: Level) -> Generator[Progress, None, None]:
        """Let the volume be seen as it stands, in the voxels of the level."""
        descent, grid = self._descent, here.grid
        assert descent is not None
        if grid.voxels > _MOST_SHOWN:
            return
        if self._keeper.show(lambda: descent.splats.voxelize(grid, self._threads), grid):
            yield self.progress(
                "level", f"binning {here.factor} is done", level=here.factor,
                draft={"shape": list(grid.shape), "voxel_mm": list(grid.voxel_mm)},
            )  # fmt: skip

    def _pause(self) -> None:
        self._keeper.pause(self.state)

    def _level(self, stage: Stage, here: Level) -> Generator[Progress, None, None]:
        """One resolution: from backprojection to refined splats and poses."""
        calibration, work, finest = self._calibration, self._schedule.work(stage), self._schedule.finest
        last = here.factor == finest and self._schedule.refines
        # A mean over pixels gains nothing from the finest ones.
        drifting = self._options.exposure and (here.factor > finest or self._schedule.levels == 1)
        measured, here = here.images, calibration.steady(here)
        if not self._under_way:
            self._descent = self._start(stage, here, _JOINT if last else _COARSE)
            self._under_way = {"step": 0, "order": [], "loss": 0.0}
            yield self.progress(
                "level", f"binning {here.factor}: {len(self._descent.splats)} splats", level=here.factor,
                splats=len(self._descent.splats),
            )  # fmt: skip
        assert self._descent is not None
        now, descent = self._under_way, self._descent
        views, cone = len(here.nominal), here.nominal.beam == "cone"
        first_sweep = min(2 * views, int(_SETTLE_IN * work.steps))
        often = _OFTEN * views if here.grid.voxels > FINE_VOXELS else work.steps
        packed = calibration.corrected(here.nominal).packed()
        while now["step"] < work.steps:
            self._pause()
            now["order"] = now["order"] or self._rng.permutation(views).tolist()
            view = now["order"].pop()
            now["step"] += 1
            # The loss follows the median, which clipping moves in blocks of pixels only.
            target = here.images[view] if here.factor == 1 else calibration.unclipped(here, descent, view, packed[view])
            now["loss"] += descent.step(packed[view], cone, target, here.mask)
            if now["order"] and now["step"] < work.steps:
                continue
            step, loss = now["step"], now["loss"]
            require_finite(loss, f"at binning {here.factor}", step)
            self._fraction = self._schedule.fraction(self._stage, step)
            due = step <= often or step // views % _SELDOM == 0 or step == work.steps
            if due and self._schedule.levels == 1 and 2 * step >= work.steps:
                calibration.settle_yaw()
            moved: dict[str, float] = {}
            found = 0
            if not calibration.fixed and step >= first_sweep and due:
                waiting = step <= _WAIT * work.steps and here.factor < self._schedule.coarsest
                moved = calibration.sweep(here, descent, finest, waiting)
                if 2 * step >= work.steps:  # by now most views agree
                    found = calibration.find_lost(here, descent, around=step == work.steps)
                packed = calibration.corrected(here.nominal).packed()
            if drifting and step >= first_sweep:
                corrected = calibration.corrected(here.nominal)
                calibration.find_exposure(descent, corrected, replace(here, images=measured))
                here = replace(here, images=calibration.exposure.corrected(measured))
            now["loss"] = 0.0
            also = f"; lost views found: {found}" if found else ""
            yield self.progress(
                "poses" if moved else "level", f"binning {here.factor}, step {step} of {work.steps}{also}",
                level=here.factor, step=step, loss=loss / (views - len(now["order"])), splats=len(descent.splats),
                **moved,
            )  # fmt: skip
            yield from self._trouble()
        if not last:
            calibration.normals = calibration.accumulate(here, descent)

    def _start(self, stage: Stage, here: Level, rates: Rates) -> Descent:
        """Splats where the first backprojection is not empty, ready for their steps."""
        calibration, work = self._calibration, self._schedule.work(stage)
        top = float(here.images.max())
        if not top > _FAINTEST:
            raise ReconstructionError(
                f"the projections are empty: their largest line integral is {top:.3g} at binning {here.factor}, "
                "expected an object that absorbs; check the sign, kind and scale of the projections"
            )
        if here.factor == self._schedule.coarsest:
            calibration.begin_together(min(STATIC_FIRST, work.steps // len(here.nominal) // 2))
        elif here.factor <= 2:
            calibration.settle_yaw()
        frames = calibration.corrected(here.nominal)
        known = self._descent.splats if self._descent is not None and here.factor == self._schedule.finest else None
        above = None if known is None else known.voxelize(here.grid, self._threads)
        splats, unit = first_splats(here.images, frames, here.grid, work.splats, self._rng, self._threads, above)
        if known is not None:
            grid = coarser(self._scan.volume, 2 * here.factor)  # of the level above
            splats = aligned(splats, known.voxelize(grid, self._threads), grid, here.scale_limits[0])
        # A level this small is done before a second thread is awake.
        threads = self._threads if len(splats) >= _WORTH_THREADS else 1
        return Descent(
            splats, here.nominal.rows, here.nominal.cols, voxel_mm=here.voxel_mm,
            density_unit=unit, steps=work.steps, rates=rates, huber=1e-4 * top,
            dssim=self._options.dssim, data_range=top, threads=threads,
            scale_limits=here.scale_limits, plane=common_plane(frames),
        )  # fmt: skip

    def _gate(self, stage: Stage, here: Level) -> Generator[Progress, None, None]:
        """Before the finest level: how freely views may move from here on."""
        if not self._under_way:
            sentence = self._calibration.gate(here)
            if sentence is None:
                return
            yield self.progress("poses", sentence, level=here.factor)
            if not self._calibration.fixed:
                return
            self._rng = self._draws(self._stage - 1)
        # Nothing was wrong. The finest level begins with what this one shows: as it is without any calibration.
        yield from self._level(self._schedule.stages[self._stage - 1], here)

    def _refine(self, stage: Stage, here: Level) -> Generator[Progress, None, None]:
        """The last stage: the poses rest, the volume gets its detail (splatcore.refine)."""
        here = self._calibration.steady(here)
        frames = self._calibration.corrected(here.nominal)
        assert self._descent is not None
        if self._weighing is None:
            self._book = Book(self._pause, self._earlier)
            trial = weigh(self._descent, *self._weighed_at(stage), self._options.seed, self._book)
            while self._weighing is None:
                try:
                    loss = next(trial)
                except StopIteration as end:
                    self._weighing = end.value
                else:
                    yield self.progress("refine", "how smooth is the object?", level=here.factor, loss=loss)
                    yield from self._trouble()
            self._earlier = []
        assert self._weighing is not None
        refinement, steps = refine(self._weighing, here, frames, self._schedule.work(stage).steps, self._rng)
        self._descent, self._book = refinement.descent, Book(self._pause, self._earlier)
        for loss in refinement.run(frames, steps, self._book):
            self._fraction = self._schedule.fraction(self._stage, refinement.step)
            yield self.progress(
                "refine", f"step {refinement.step} of {steps}", level=here.factor, step=refinement.step, loss=loss,
                splats=len(self._descent.splats),
            )  # fmt: skip
            yield from self._trouble()
        self._calibration.normals = self._calibration.accumulate(here, self._descent)

    def _weighed_at(self, stage: Stage) -> tuple[Level, Frames, int]:
        """The level at which the last stage finds out how smooth the object is, its frames, and its splats. Fine voxels
        say the same about it as coarser ones, in three times the time."""
        factor = stage.factor
        while self._scan.volume.voxels > factor**3 * FINE_VOXELS and factor < self._schedule.coarsest:
            factor *= 2
        here = self._calibration.steady(level(self._scan, factor))
        return here, self._calibration.corrected(here.nominal), self._schedule.work(Stage("level", factor)).splats

    def _trouble(self) -> Generator[Progress, None, None]:
        """Say so where the state could not be kept, once each time."""
        word, self._keeper.trouble = self._keeper.trouble, ""
        if word:
            yield self.progress("checkpoint", word)

    def finish(self, whole: bool = True) -> Generator[Progress, None, Reconstruction]:
        """Voxels, uncertainties and the report; `whole`: all stages are done."""
        scan, options, calibration = self._scan, self._options, self._calibration
        corrected = calibration.corrected(scan.frames)
        yield self.progress("diagnose", "compare nominal and corrected geometry")
        here = calibration.steady(level(scan, self._schedule.finest))
        descent = self._descent
        assert descent is not None  # a run is not interrupted before its first volume
        if not whole:  # at full resolution, though the splats are those of a coarser one
            descent = descent.on_detector(here.nominal.rows, here.nominal.cols, here.voxel_mm, here.scale_limits)
            calibration.normals = calibration.accumulate(here, descent)
        assert calibration.normals is not None
        result = conclude(
            replace(scan, projections=calibration.exposure.corrected(scan.projections)), options, descent.splats,
            corrected, calibration.motions, calibration.entries(corrected, self._orientation.entries()),
            calibration.normals, calibration.sigmas(here, descent, corrected), calibration.gauge, self._clock.timings,
            self._clock.began,
        )  # fmt: skip
        findings = result.report["findings"]
        findings.insert(0, orientation_finding(self._orientation, options))
        if options.exposure:
            findings.append(finding(calibration.exposure.offset))
        if calibration.decision is not None:
            findings.append(calibration.decision.finding())
        if self._weighing is not None:
            findings.append(self._weighing.finding())
        if not whole:
            mark_partial(result.report, self._fraction)
        self._fraction = 1.0
        yield self.progress("done", result.report["verdict"])
        return result
