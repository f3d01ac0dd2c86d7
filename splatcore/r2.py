"""The methods that this engine is measured against, with its own kernels: R2-Gaussian and the paper.

R2-Gaussian (Zha et al., NeurIPS 2024): one resolution, splats drawn from FDK, L1 + 0.25 D-SSIM + 0.05 TV, adaptive
control of their number, poses taken as true. The paper (Choi et al., CVPR 2026): the same without TV, every view's
quaternion and translation moved by Adam from the first step on. Constants are theirs, in the units of
`splatcore.scene`. Known differences: splats start at voxel centres, not at corners; log scales are bounded by
clipping in place of a sigmoid; footprints end at four standard deviations.

    drain(reconstruct(scan, Options(method="paper")))
"""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from splatcore import _native
from splatcore.checkpoint import identity
from splatcore.conclusion import conclude, mark_partial
from splatcore.densify import Rules, ScreenGradient, densify
from splatcore.descent import Descent, Rates
from splatcore.errors import OptionsError, ReconstructionError
from splatcore.geometry import Array, RigidMotions
from splatcore.increments import Increments
from splatcore.keeper import Concluding, Keeper
from splatcore.machine import threads_allowed
from splatcore.options import Options
from splatcore.poses import Prior, accumulate, sigmas
from splatcore.progress import Progress
from splatcore.reconstruction import Reconstruction
from splatcore.scan import Scan
from splatcore.scene import Scene, scene_of
from splatcore.schedule import Clock
from splatcore.splats import Splats
from splatcore.static import Static, split_static
from splatcore.variation import Variation

STEPS, SPLATS = 30_000, 50_000
_OCCUPIED = 0.05  # density above which a voxel may hold a splat
_START_DENSITY = 0.15  # of the voxel's
_RATES = Rates(mean=2e-4, log_scale=5e-3, quat=1e-3, density=1e-2, end=0.1)
_SCALES = (0.001, 1.0)  # smallest and largest standard deviation
_SSIM, _TV = 0.25, 0.05  # weights of 1 - SSIM and of the total variation beside L1
_DENSIFY_FROM, _DENSIFY_EVERY, _DENSIFY_UNTIL = 500, 100, 0.5  # steps; the last a share of all
# The core's loss is (1 - d) L1 + d (1 - SSIM) / 2: with this d it is R2-Gaussian's times _WEIGHT.
_DSSIM = 2 * _SSIM / (1 + 2 * _SSIM)
_WEIGHT = 1 - _DSSIM
_CORNER = 1e-6  # of the Huber function, so small that it is L1
# What changes during a run beside splats, poses and generator.
_STATE = ("_fraction", "_step", "_order", "_loss", "_drawn")


@dataclass(frozen=True)
class Switches:
    """What is varied in ablations. None: as the method has it."""

    variation: bool | None = None  # the TV term
    moving: bool | None = None  # poses
    covariance_path: bool = True  # the part of the pose gradient that goes through the splats' covariance
    densify: bool = True
    pose_rate: float = 1.0  # times the paper's; 30,000 / steps gives a shorter run the same reach
    unit: float | None = None  # 1/mm: the attenuation that counts as 1, where it is known


def resolved(scan: Scan, options: Options) -> Options:
    """Options with every default filled in; the loss and the resolution are the method's own.

    Raises OptionsError where the method cannot do what is asked of it.
    """
    if options.method == "r2":  # knows no calibration, and `full` is only the default
        options = replace(options, calibrate="none")
    elif options.calibrate == "static":
        raise OptionsError("calibrate: got static with method paper, expected full or none: it moves single views")
    return replace(
        options,
        threads=options.threads or threads_allowed(),
        splats=options.splats or SPLATS,
        steps=options.steps or STEPS,
        dssim=_DSSIM,
    )


def reconstruct(
    scan: Scan, options: Options, switches: Switches | None = None, keeper: Keeper | None = None
) -> Generator[Progress, None, Reconstruction]:
    """Reconstruct by `options.method`, r2 or paper. Yields Progress, returns the Reconstruction.

    keeper: as in `splatcore.reconstruct`; the switches of a run that is gone on with must be the same.

    Raises OptionsError, ReconstructionError where the projections hold nothing to reconstruct, and Stopped.
    """
    options, keeper = resolved(scan, options), keeper or Keeper()
    state, word = keeper.recall(lambda: identity(scan, options), (Rates, Splats))
    run = _Run(scan, options, switches or Switches(), keeper)
    if state is not None:
        run.go_on(state)
    facts = f"{len(scan.frames)} views of {scan.frames.rows} x {scan.frames.cols}"
    yield run.progress("start", f"{word}; {facts}" if word else facts)
    whole = True
    try:
        yield from run.optimise()
    except Concluding:
        whole = False
    yield run.progress("diagnose", "compare nominal and corrected geometry")
    result = run.finish(whole)
    yield run.progress("done", result.report["verdict"])
    return result


class _Run:
    """One reconstruction under way."""

    def __init__(self, scan: Scan, options: Options, switches: Switches, keeper: Keeper) -> None:
        assert options.threads is not None and options.splats is not None and options.steps is not None
        self._scan, self._options, self._switches, self._keeper = scan, options, switches, keeper
        self._threads, self._steps = options.threads, options.steps
        self._clock = Clock()
        self._fraction = 0.0
        self._step, self._order = 0, list[int]()  # views left in this epoch
        self._loss, self._drawn = 0.0, 0  # of this epoch
        self._rng = np.random.default_rng(options.seed)
        self._scene = scene_of(scan, self._threads, switches.unit)
        scene = self._scene
        paper = options.method == "paper"
        moving = options.calibrate == "full" if switches.moving is None else switches.moving
        self._poses = Increments(scene.frames, self._steps, switches.pose_rate) if moving else None
        vary = not paper if switches.variation is None else switches.variation
        self._variation = Variation(scene.grid, _WEIGHT * _TV, self._threads) if vary else None
        splats = first_splats(scene, options.splats, self._rng)
        self._descent = Descent(
            splats, scan.frames.rows, scan.frames.cols, voxel_mm=1.0, density_unit=1.0, steps=self._steps,
            rates=_RATES, huber=_CORNER, dssim=_DSSIM, data_range=1.0, threads=self._threads, scale_limits=_SCALES,
        )  # fmt: skip

        self._screen = self._new_screen()

    def _new_screen(self) -> ScreenGradient:
        frames = self._scene.frames
        return ScreenGradient(len(self._descent.splats), frames.rows, frames.cols, frames.beam == "cone")

    def state(self) -> dict[str, Any]:
        """All that `go_on` needs, between any two steps."""
        plain = {name: getattr(self, name) for name in _STATE}
        return plain | {
            "clock": self._clock.state(), "rng": self._rng.bit_generator.state, "descent": self._descent.state(),
            "screen": self._screen.state(), "poses": self._poses and self._poses.state(),
        }  # fmt: skip

    def go_on(self, state: dict[str, Any]) -> None:
        """From where an interrupted run was."""
        for name in _STATE:
            setattr(self, name, state[name])
        self._clock.go_on(state["clock"])
        self._rng.bit_generator.state = state["rng"]
        self._descent.load(state["descent"])
        self._screen = self._new_screen()
        self._screen.load(state["screen"])
        if self._poses is not None:
            self._poses.load(state["poses"])

    def progress(self, stage: str, message: str, **facts: object) -> Progress:
        return Progress(stage, self._fraction, message, self._clock.seconds, **facts)  # type: ignore[arg-type]

    def optimise(self) -> Generator[Progress, None, None]:
        """All Adam steps, one view each, with adaptive control in the first half."""
        scene, descent, rules = self._scene, self._descent, Rules()
        packed, cone, views = scene.frames.packed(), scene.frames.beam == "cone", len(scene.frames)
        until = int(_DENSIFY_UNTIL * self._steps) if self._switches.densify else 0
        v_motion = np.zeros(6)
        while self._step < self._steps:
            self._keeper.pause(self.state)
            self._order = self._order or self._rng.permutation(views).tolist()
            view = self._order.pop()
            self._step += 1
            step = self._step
            frame = packed[view] if self._poses is None else self._poses.frame(view)
            self._loss += descent.differentiate(
                frame, cone, scene.images[view], scene.mask, None if self._poses is None else v_motion
            )
            self._drawn += 1
            if step < until:
                self._screen.add(frame, descent.splats.means, descent.gradient.means)
            if self._poses is not None:
                self._poses.step(view, self._pose_gradient(v_motion), step - 1)
            if self._variation is not None:
                self._variation.add_gradient(descent.splats, descent.gradient, self._rng)
            descent.update()
            if _DENSIFY_FROM < step < until and step % _DENSIFY_EVERY == 0:
                if len(descent.splats) < rules.most:
                    hard = self._screen.mean() / np.float32(_WEIGHT)
                    descent.repopulate(*densify(descent.splats, hard, rules, scene.grid, self._rng))
                self._screen = self._new_screen()
            if self._order and step < self._steps:
                continue
            loss, drawn = self._loss, self._drawn
            if not (np.isfinite(loss) and len(descent.splats)):
                raise ReconstructionError(
                    f"the loss became {loss} with {len(descent.splats)} splats left at step {step}; try another method"
                )
            self._fraction = 0.9 * step / self._steps
            self._loss, self._drawn = 0.0, 0
            yield self.progress(
                "level", f"step {step} of {self._steps}", level=1, step=step, splats=len(descent.splats),
                loss=loss / drawn * scene.unit * scene.length_mm,
            )  # fmt: skip

    def _pose_gradient(self, v_motion: Array) -> Array:
        """dL/d(omega, tau), or the part of it that goes through the splats' means."""
        if self._switches.covariance_path:
            return v_motion
        moment = self._descent.splats.means.T @ self._descent.gradient.means  # sum of x_i g_j
        torque = moment - moment.T
        return np.array([torque[1, 2], torque[2, 0], torque[0, 1], *v_motion[3:]], np.float64)

    def finish(self, whole: bool) -> Reconstruction:
        """The result in mm, with its report; `whole`: all steps are done."""
        scan, scene = self._scan, self._scene
        timings = {"binning_1": self._clock.seconds}
        splats = scene.splats_mm(self._descent.splats)
        motions = RigidMotions.identity(len(scan.frames))
        if self._poses is not None:
            motions = scene.motions_mm(self._poses.motions())
        corrected = motions.correct(scan.frames)
        renderer = _native.Renderer32(scan.frames.rows, scan.frames.cols, self._threads)
        top = float(scan.projections.max())
        normals = accumulate(renderer, splats, corrected, scan.projections, scene.mask, top)
        unmoved = np.full((len(corrected), 3), np.nan)
        sigma = (unmoved, unmoved)
        if self._poses is not None:
            # Neither method states any; these are what the images say, with a prior as wide as the volume.
            sigma = sigmas(normals, Prior(1.0, scene.length_mm))
        gauge = "nominal world kept" if self._poses is None else "not settled: poses and splats move freely"
        # What all views share in their own axes is the scanner's; the frames have it in them either way.
        static, corrections = split_static(scan.frames, Static(), motions)
        result = conclude(
            scan, self._options, splats, corrected, corrections, (static.to_json(scan.frames), {}), normals, sigma,
            gauge, timings, self._clock.began,
        )  # fmt: skip
        if not whole:
            mark_partial(result.report, self._fraction)
        self._fraction = 1.0
        return result


def first_splats(scene: Scene, count: int, rng: np.random.Generator) -> Splats:
    """Up to `count` splats at voxels drawn from those that are not empty, as wide as their three nearest neighbours
    are far (root mean square), with a share of the voxel's density."""
    occupied = np.flatnonzero(scene.volume > _OCCUPIED)
    if len(occupied) < 4:
        raise ReconstructionError(
            f"the first backprojection has {len(occupied)} voxels that are not empty, expected an object inside the "
            "volume; check the geometry, and the sign and kind of the projections"
        )
    chosen = np.sort(rng.choice(occupied, min(count, len(occupied)), replace=False))
    k, j, i = np.unravel_index(chosen, scene.grid.shape)
    x, y, z = scene.grid.axes_mm()
    means = np.stack([x[i], y[j], z[k]], axis=1)
    distance, _ = cKDTree(means).query(means, k=4)
    width = np.clip(np.sqrt((distance[:, 1:] ** 2).mean(axis=1)), *_SCALES)
    n = len(chosen)
    return Splats(
        means=means.astype(np.float32),
        scales=np.repeat(width[:, None], 3, axis=1).astype(np.float32),
        quats=np.tile(np.array([1, 0, 0, 0], np.float32), (n, 1)),
        density=(_START_DENSITY * scene.volume.ravel()[chosen]).astype(np.float32),
    )
