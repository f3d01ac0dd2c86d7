"""The joint reconstruction: splats and poses together, coarse to fine. Read this file first.

At each resolution: backproject with the poses found so far (FDK), put splats where the volume is not empty,
then alternate. One epoch of Adam on the splats, one view a step, for every sweep of Gauss-Newton over
the poses. After each sweep the freedoms that no projection shows are settled, and the splats follow.

    events = reconstruct(scan, options)      # a generator of Progress
    for event in events: ...                 # its return value is the Reconstruction
"""

from __future__ import annotations

import time
from collections.abc import Generator
from dataclasses import dataclass, replace

import numpy as np

from splatcore import r2
from splatcore.conclusion import conclude
from splatcore.descent import Descent, Rates
from splatcore.errors import OptionsError, ReconstructionError
from splatcore.exposure import Exposure, finding
from splatcore.gate import Decision, gate, information
from splatcore.gauge import settle
from splatcore.geometry import Array, Frames, RigidMotions
from splatcore.jitter import narrowed
from splatcore.machine import threads_allowed
from splatcore.options import Options
from splatcore.orientation import Verdict, oriented
from splatcore.orientation import finding as orientation_finding
from splatcore.planar import common_plane, unseen
from splatcore.poses import Normals, Prior, accumulate, step_full
from splatcore.progress import Progress
from splatcore.pyramid import Level, factors, level
from splatcore.reconstruction import Reconstruction
from splatcore.redundancy import lopsidedness, orbit
from splatcore.refine import MOVING, Weighing, refine, weigh
from splatcore.scan import Scan
from splatcore.splats import Similarity
from splatcore.start import first_splats
from splatcore.static import (
    Static,
    accumulate_static,
    axis_column,
    sigmas_of_mean,
    split_static,
    step_static,
    without_doubtful_yaw,
)
from splatcore.staticreport import as_entries
from splatcore.trial import held_out_views
from splatcore.uncertainty import pose_covariance

# Adam steps at each binning factor. Coarse steps cost a hundredth of fine ones.
_STEPS = {8: 600, 4: 750, 2: 1200, 1: 2000}
_REFINING, _REFINING_EPOCHS = 6000, 100  # at most, of the last stage, poses at rest
_MOST_EPOCHS = 200
_QUALITY = {"preview": 1.0, "normal": 1.0, "fine": 1.5}
_FINEST = {"preview": 2, "normal": 1, "fine": 1}
_SETTLE_IN = 0.25  # share of a level's steps before its first pose sweep, at most two epochs
# Above full resolution what residuals hold is mostly the model's own error, alike in thousands of pixels. Taken
# for independent noise it drives a view of a nearly round object round its axis into a wrong minimum.
_CAUTION = 1000.0
_LOPSIDED = 0.2  # share of the detector's half by which the axis may be off its middle
_STATIC_FIRST = 3  # sweeps of the coarsest level that move no single view
_REACH_PX = 1.5  # longest pose step, in pixels of the level
_WORTH_THREADS = 4_000  # splats
_FAINTEST = 1e-30  # line integral; single precision has no room for the squares of less
_HUBER = 2.0  # standard deviations of the residual beyond which a pixel counts less for the poses

# The prior where the scanner states no tolerance: degrees, and a share of the volume's half width.
_LOOSE_ROTATION_DEG, _LOOSE_TRANSLATION = 5.0, 0.1
_TIGHTEST = 1e-6  # degrees or mm: a tolerance of zero says that nothing moves

_GAUGE = (
    "world settled where the poses are nearest nominal: mean rotation zero; translation and, for a cone beam, "
    "magnification by least squares"
)


def drain(events: Generator[Progress, None, Reconstruction]) -> Reconstruction:
    """Run a reconstruction to its end without looking at its events."""
    while True:
        try:
            next(events)
        except StopIteration as end:
            result: Reconstruction = end.value
            return result


def reconstruct(scan: Scan, options: Options | None = None) -> Generator[Progress, None, Reconstruction]:
    """Reconstruct a scan. Yields Progress, returns the Reconstruction.

    Raises ReconstructionError where the projections hold nothing to reconstruct.
    """
    if options is not None and options.method != "splatct":
        return (yield from r2.reconstruct(scan, options))
    options = resolved(scan, options or Options())
    assert options.threads is not None
    scan, orientation = oriented(scan, options, options.threads)
    run = _Run(scan, options, orientation)
    yield run.progress("start", f"{len(scan.frames)} views of {scan.frames.rows} x {scan.frames.cols}")
    scales = factors(scan, _FINEST[options.quality])
    run.plan(scales)
    for factor in scales:
        here = level(scan, factor)
        yield from run.level(here)
        if factor == scales[max(len(scales) - 2, 0)] and factor != scales[-1]:
            yield from run.gate(here)
    if options.quality != "preview":
        yield from run.refine(here)
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
    edge = scan.volume.voxels ** (1 / 3) / 128
    # Finer voxels show more detail, but as few views hold it no better: past 128 many more splats would fit noise.
    splats = options.splats or int(np.clip(30_000 * min(edge**1.5, edge**0.5), 2_000, 2_000_000))
    return replace(options, threads=threads, splats=splats)


@dataclass(frozen=True)
class _Work:
    """What a level is expected to cost, in splat-steps."""

    steps: int
    splats: int

    @property
    def cost(self) -> float:
        return self.steps * (self.splats + 500)


class _Run:
    """One reconstruction under way: the splats, the poses and the clock."""

    def __init__(self, scan: Scan, options: Options, orientation: Verdict) -> None:
        self._scan, self._options, self._orientation = scan, options, orientation
        assert options.threads is not None and options.splats is not None
        self._threads, self._most_splats = options.threads, options.splats
        self._rng = np.random.default_rng(options.seed)
        self._began = time.monotonic()
        self._timings: dict[str, float] = {}
        half = float(scan.volume.half_extent_mm().max())
        stated = scan.tolerance
        rotation_deg, translation = _LOOSE_ROTATION_DEG, _LOOSE_TRANSLATION * half
        if stated and stated.rotation_deg is not None:
            rotation_deg = max(stated.rotation_deg, _TIGHTEST)
        if stated and stated.translation_mm is not None:
            translation = max(stated.translation_mm, _TIGHTEST)
        self._prior = Prior(float(np.deg2rad(rotation_deg)), translation)
        self._radius = half
        self._static = Static()
        self._sweeps = 0
        self._static_sweeps = 0  # how many more sweeps solve the static part alone, before the views are free
        # On part of a turn, or with the axis far from the detector's middle, constant errors are hardly told from the
        # object's place: free views take them up instead.
        self._separable = orbit(scan.frames).full and lopsidedness(scan.frames) < _LOPSIDED
        self._yaw_free = options.calibrate == "static" or (options.calibrate == "full" and self._separable)
        self._motions = RigidMotions.identity(len(scan.frames))
        self._decision: Decision | None = None
        self._descent: Descent | None = None  # of the finest level so far
        self._weighing: Weighing | None = None
        self._normals: Normals | None = None
        self._exposure = Exposure(len(scan.frames))
        self._deviation = 0.0  # robust residual, line-integral units, from the last sweep
        self._works: dict[int, _Work] = {}
        self._refining = _Work(0, 0)
        self._done = 0.0
        self._fraction = 0.0

    def plan(self, scales: list[int]) -> None:
        """Steps and splats of each level: splats grow with the detail there is to see."""
        quality, most = _QUALITY[self._options.quality], _MOST_EPOCHS * len(self._scan.frames)
        for factor in scales:
            steps = int(min(_STEPS[factor], most) * quality)
            splats = max(min(1_500, self._most_splats), int(self._most_splats / factor**1.5))
            self._works[factor] = _Work(steps, splats)
        if self._options.quality != "preview":
            steps = min(_REFINING, _REFINING_EPOCHS * len(self._scan.frames))
            self._refining = _Work(int(steps * quality), self._works[scales[-1]].splats)

    def progress(self, stage: str, message: str, **facts: object) -> Progress:
        return Progress(stage, self._fraction, message, time.monotonic() - self._began, **facts)  # type: ignore[arg-type]

    def level(self, here: Level) -> Generator[Progress, None, None]:
        """One resolution: from backprojection to refined splats and poses."""
        began, work = time.monotonic(), self._works[here.factor]
        measured, here = here.images, self._steady(here)
        # A mean over pixels gains nothing from the finest ones.
        drifting = self._options.exposure and (here.factor > min(self._works) or len(self._works) == 1)
        top = float(here.images.max())
        if not top > _FAINTEST:
            raise ReconstructionError(
                f"the projections are empty: their largest line integral is {top:.3g} at binning {here.factor}, "
                "expected an object that absorbs; check the sign, kind and scale of the projections"
            )
        if here.factor == max(self._works) and self._options.calibrate == "full" and self._separable:
            self._static_sweeps = min(_STATIC_FIRST, work.steps // len(here.nominal) // 2)
        elif here.factor <= 2:
            self._settle_yaw()
        frames = self._corrected(here.nominal)
        last = here.factor == min(self._works) and self._refining.steps > 0
        splats, unit = first_splats(here.images, frames, here.grid, work.splats, self._rng, self._threads)
        # A level this small is done before a second thread is awake.
        threads = self._threads if len(splats) >= _WORTH_THREADS else 1
        descent = Descent(
            splats, here.nominal.rows, here.nominal.cols, voxel_mm=here.voxel_mm,
            density_unit=unit, steps=work.steps, rates=MOVING if last else Rates(), huber=1e-4 * top,
            dssim=self._options.dssim, data_range=top, threads=threads,
            plane=common_plane(frames),
        )  # fmt: skip
        yield self.progress(
            "level", f"binning {here.factor}: {len(splats)} splats", level=here.factor, splats=len(splats)
        )
        views, cone, loss = len(frames), frames.beam == "cone", 0.0
        first_sweep = min(2 * views, int(_SETTLE_IN * work.steps))
        packed = frames.packed()
        order: list[int] = []
        for step in range(1, work.steps + 1):
            order = order or list(self._rng.permutation(views))
            view = order.pop()
            loss += descent.step(packed[view], cone, here.images[view], here.mask)
            if order and step < work.steps:
                continue
            if not np.isfinite(loss):
                raise ReconstructionError(
                    f"the loss became {loss} at binning {here.factor}, step {step}; a bug, please report it"
                )
            self._advance(work, step)
            if len(self._works) == 1 and 2 * step >= work.steps:
                self._settle_yaw()
            moved: dict[str, float] = {}
            if not self._fixed and step >= first_sweep:
                moved = self._sweep(here, descent)
                packed = self._corrected(here.nominal).packed()
            if drifting and step >= first_sweep:
                corrected = self._corrected(here.nominal)
                self._exposure.update(descent.renderer, descent.splats, corrected, measured, here.mask)
                here = replace(here, images=self._exposure.corrected(measured))
            yield self.progress(
                "poses" if moved else "level", f"binning {here.factor}, step {step} of {work.steps}", level=here.factor,
                step=step, loss=loss / (views - len(order)), splats=len(splats), **moved,
            )  # fmt: skip
            loss = 0.0
        self._done += work.cost
        self._descent = descent
        if not last:
            self._normals = self._accumulate(here, descent)
        self._timings[f"binning_{here.factor}"] = time.monotonic() - began

    def refine(self, here: Level) -> Generator[Progress, None, None]:
        """The last stage: the poses rest, the volume gets its detail (splatcore.refine)."""
        assert self._descent is not None
        began, work, here = time.monotonic(), self._refining, self._steady(here)
        frames = self._corrected(here.nominal)
        trial = weigh(self._descent, here, frames, held_out_views(len(frames)), self._options.seed)
        while self._weighing is None:
            try:
                loss = next(trial)
            except StopIteration as end:
                self._weighing = end.value
            else:
                yield self.progress("refine", "how smooth is the object?", level=here.factor, loss=loss)
        assert self._weighing is not None
        refinement, steps = refine(self._weighing, here, frames, work.steps, self._rng)
        self._descent = refinement.descent
        for loss in refinement.run(frames, steps):
            self._advance(work, refinement.step)
            yield self.progress(
                "refine", f"step {refinement.step} of {steps}", level=here.factor, step=refinement.step, loss=loss,
                splats=len(self._descent.splats),
            )  # fmt: skip
        self._normals = self._accumulate(here, self._descent)
        self._timings["refine"] = time.monotonic() - began

    def gate(self, here: Level) -> Generator[Progress, None, None]:
        """Before the finest level: how freely views may move from here on."""
        if self._options.calibrate != "full" or self._options.gate == "off":
            return
        assert self._normals is not None
        began, time_s = time.monotonic(), self._scan.time_s
        moment = None if time_s is None else np.array(time_s)
        scanner = self._at(here.nominal).apply(here.nominal)
        self._decision = gate(
            replace(self._steady(here), nominal=scanner),
            self._motions,
            self._normals,
            self._prior,
            time=moment,
            seed=self._options.seed,
            threads=self._threads,
        )
        if self._decision.model == "full":
            self._prior = narrowed(self._prior, self._motions, information(self._normals))
        _, self._motions = settle(scanner, self._decision.motions)
        self._timings["gate"] = time.monotonic() - began
        yield self.progress("poses", self._decision.sentence(), level=here.factor)

    def _settle_yaw(self) -> None:
        """Once views are free and their resolution is good enough to judge: is there a yaw at all?"""
        if self._options.calibrate == "full" and self._yaw_free and self._normals is not None:
            sigma = sigmas_of_mean(self._normals, self._scan.frames, self._prior)[3]
            self._static, self._yaw_free = without_doubtful_yaw(
                self._scan.frames, self._static, self._motions, float(sigma)
            )

    def _steady(self, here: Level) -> Level:
        """The level as if all views had been exposed alike."""
        return replace(here, images=self._exposure.corrected(here.images))

    def _at(self, nominal: Frames) -> Static:
        """The static part in the pixels of a level."""
        return self._static.binned(self._scan.frames.cols // nominal.cols)

    @property
    def _still(self) -> bool:
        """Whether the gate found that no view moves."""
        return self._decision is not None and self._decision.model == "none"

    @property
    def _fixed(self) -> bool:
        """Whether the geometry is left as it is."""
        return self._options.calibrate == "none" or (self._still and not self._separable)

    @property
    def _alone(self) -> bool:
        """Whether the static part is solved and no view moves for itself."""
        return self._options.calibrate == "static" or self._static_sweeps > 0 or self._still

    def _corrected(self, nominal: Frames) -> Frames:
        """Static part first, then every view's own."""
        return self._motions.correct(self._at(nominal).apply(nominal))

    def _accumulate(self, here: Level, descent: Descent, some: slice = slice(None)) -> Normals:
        """Normal equations of all or some views, with the detector's yaw as long as it is solved."""
        huber = _HUBER * self._deviation or float(np.abs(here.images).max())
        nominal, motions, images = here.nominal[some], self._motions[some], here.images[some]
        renderer, splats, static = descent.renderer, descent.splats, self._at(here.nominal)
        if self._alone or self._yaw_free:
            return accumulate_static(renderer, splats, nominal, static, motions, images, here.mask, huber)
        return accumulate(renderer, splats, motions.correct(static.apply(nominal)), images, here.mask, huber)

    def _advance(self, work: _Work, step: int) -> None:
        total = sum(w.cost for w in self._works.values()) + self._refining.cost
        self._fraction = 0.9 * (self._done + work.cost * step / work.steps) / total

    def _sweep(self, here: Level, descent: Descent) -> dict[str, float]:
        """One Gauss-Newton step of all poses; the splats follow strain and gauge. Returns how far poses moved."""
        before, static = self._motions, self._at(here.nominal)
        coarse = here.factor > min(self._works) or self._sweeps < _STATIC_FIRST
        caution = _CAUTION if coarse else 1.0
        alone = self._alone
        # Four numbers need not see every view of a fine level.
        some = slice(self._sweeps % 3, None, 3) if alone and here.factor <= 2 and len(before) > 40 else slice(None)
        normals = self._accumulate(here, descent, some)
        self._normals = normals
        self._sweeps += 1
        self._static_sweeps -= 1
        self._deviation = 1.2533 * float(normals.residual_abs.sum() / max(normals.pixels.sum(), 1.0))
        similarity = Similarity(np.eye(3), np.zeros(3))
        if alone:
            static, strain, _ = step_static(normals, here.nominal[some], static, before[some], self._prior, caution)
        else:
            reach = _REACH_PX * here.pixel_at_isocentre_mm
            limit = np.array([reach / self._radius] * 3 + [3 * reach] * 3)
            turned = float(np.deg2rad(static.yaw_deg))
            motions, strain, yaw = step_full(normals, before, self._prior, limit, caution, turned)
            static = replace(static, yaw_deg=static.yaw_deg + float(np.rad2deg(yaw)))
            if self._separable:
                static, motions = split_static(here.nominal, static, motions)
            if self._decision is not None:
                motions = self._decision.restrict(static.apply(here.nominal), motions, normals)
            similarity, self._motions = settle(static.apply(here.nominal), motions)
        means = (descent.splats.means @ (np.eye(3) + strain)).astype(np.float32)
        descent.replace(replace(descent.splats, means=means).moved(similarity))
        binning = self._scan.frames.cols // here.nominal.cols
        static = static.binned(1 / binning)
        column = here.pixel_at_isocentre_mm / binning
        shift, self._static = column * (static.offset_px - self._static.offset_px), static
        omega, tau = (self._motions @ before.inverse()).vectors()
        return {
            "moved_deg": float(np.rad2deg(np.sqrt((omega**2).sum(axis=1).mean()))),
            "moved_mm": float(np.hypot(np.sqrt((tau**2).sum(axis=1).mean()), shift)),
        }

    def finish(self) -> Generator[Progress, None, Reconstruction]:
        """Voxels, uncertainties and the report."""
        assert self._descent is not None and self._normals is not None
        scan, options = self._scan, self._options
        corrected = self._corrected(scan.frames)
        yield self.progress("diagnose", "compare nominal and corrected geometry")
        result = conclude(
            replace(scan, projections=self._exposure.corrected(scan.projections)), options, self._descent.splats,
            corrected, self._motions, self._static_entries(corrected), self._normals, self._sigmas(corrected),
            _GAUGE if options.calibrate == "full" else "nominal world kept", self._timings, self._began,
        )  # fmt: skip
        findings = result.report["findings"]
        findings.insert(0, orientation_finding(self._orientation, options))
        if options.exposure:
            findings.append(finding(self._exposure.offset))
        if self._decision is not None:
            findings.append(self._decision.finding())
        if self._weighing is not None:
            findings.append(self._weighing.finding())
        self._fraction = 1.0
        yield self.progress("done", result.report["verdict"])
        return result

    def _static_entries(self, corrected: Frames) -> tuple[dict[str, float], dict[str, float]]:
        """The scanner's constant errors, and the standard deviations of those that were solved."""
        assert self._normals is not None
        nominal, orientation = self._scan.frames, self._orientation.entries()
        if self._options.calibrate == "full" and not self._separable:
            return {"cor_px": axis_column(corrected)} | orientation, {}
        found = self._static.to_json(nominal) | orientation
        if self._alone:
            return found, as_entries(step_static(self._normals, nominal, self._static, self._motions, self._prior)[2])
        if self._options.calibrate == "full":
            return found, as_entries(sigmas_of_mean(self._normals, nominal, self._prior))
        return found, {}

    def _sigmas(self, corrected: Frames) -> tuple[Array, Array]:
        """Standard deviations of omega [views, 3] rad and tau [views, 3] mm; zero for what was not fitted."""
        if self._options.calibrate != "full":
            return np.zeros((len(corrected), 3)), np.zeros((len(corrected), 3))
        assert self._descent is not None
        here = self._steady(level(self._scan, min(self._works)))
        huber = _HUBER * self._deviation or float(np.abs(here.images).max())
        covariance = pose_covariance(
            self._descent.splats,
            self._corrected(here.nominal),
            here.images,
            here.mask,
            huber,
            self._prior,
            self._threads,
        )
        omega, tau = np.split(np.sqrt(np.diagonal(covariance, axis1=1, axis2=2)), 2, axis=1)
        if corrected.beam == "parallel":
            # A shift along the ray changes nothing, so any component that shares in it is unbounded.
            tau = np.where(np.abs(self._scan.frames.source) > 1e-3, np.inf, tau)
        if corrected.line:  # likewise out of the plane
            omega[unseen(corrected)[0]] = tau[unseen(corrected)[1]] = np.inf
        return omega, tau
