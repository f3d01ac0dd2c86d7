"""The geometry of a run: what is known by now of the scanner's constant errors and of every view's motion.

`sweep` is one Gauss-Newton step of all of it; the splats follow the strain and the gauge.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from splatcore import _native
from splatcore.clipping import clipping
from splatcore.descent import Descent
from splatcore.exposure import Exposure
from splatcore.gate import Decision, gate, information
from splatcore.gauge import settle
from splatcore.geometry import Array, Frames, RigidMotions
from splatcore.jitter import narrowed
from splatcore.lost import find_again, lost_views
from splatcore.lowpass import HUBER, NORMAL, low_passed
from splatcore.options import Options
from splatcore.planar import unseen
from splatcore.poses import Normals, Prior, accumulate, step_full
from splatcore.pyramid import Level
from splatcore.redundancy import lopsidedness, orbit
from splatcore.scan import Scan
from splatcore.splats import Floats, Similarity, Splats
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
from splatcore.uncertainty import pose_covariance

# Above full resolution what residuals hold is mostly the model's own error, alike in thousands of pixels. Taken
# for independent noise it drives a view of a nearly round object round its axis into a wrong minimum.
_CAUTION = 1000.0
_LOPSIDED = 0.2  # share of the detector's half by which the axis may be off its middle
STATIC_FIRST = 3  # sweeps of the coarsest level that move no single view
_REACH_PX = 1.5  # longest pose step, in pixels of the level

# The prior where the scanner states no tolerance: degrees, and a share of the volume's half width.
_LOOSE_ROTATION_DEG, _LOOSE_TRANSLATION = 5.0, 0.1
_TIGHTEST = 1e-6  # degrees or mm: a tolerance of zero says that nothing moves

_GAUGE = (
    "world settled where the poses are nearest nominal: mean rotation zero; translation and, for a cone beam, "
    "magnification by least squares"
)

# What changes during a run, and so is kept in a checkpoint.
_STATE = (
    "prior", "static", "static_sweeps", "motions", "decision", "normals",
    "_sweeps", "_yaw_free", "_deviation", "_found", "_in_vain",
)  # fmt: skip


class Calibration:
    """Static part, motions and exposure of the views, as far as options let them be found."""

    def __init__(self, scan: Scan, options: Options) -> None:
        self._scan, self._options = scan, options
        assert options.threads is not None
        self._threads = options.threads
        self._radius = half = float(scan.volume.half_extent_mm().max())
        self.prior = _prior(scan, half)
        self.static = Static()
        self.static_sweeps = 0  # how many more sweeps solve the static part alone, before the views are free
        self._sweeps = 0
        # On part of a turn, or with the axis far from the detector's middle, constant errors are hardly told from the
        # object's place: free views take them up instead.
        self._separable = orbit(scan.frames).full and lopsidedness(scan.frames) < _LOPSIDED
        self._yaw_free = options.calibrate == "static" or (options.calibrate == "full" and self._separable)
        self.motions = RigidMotions.identity(len(scan.frames))
        self.decision: Decision | None = None
        self.normals: Normals | None = None
        self.exposure = Exposure(len(scan.frames))
        self._clipping = clipping(scan.projections, scan.bad_pixels)
        self._found = np.zeros(len(scan.frames), bool)  # views that were lost
        self._in_vain = np.zeros(len(scan.frames), bool)  # views looked for at this level and not found
        self._deviation = 0.0  # robust residual, line-integral units, from the last sweep

    def state(self) -> dict[str, Any]:
        return {name: getattr(self, name) for name in _STATE} | {"exposure": self.exposure.offset}

    def go_on(self, state: dict[str, Any]) -> None:
        """From where an interrupted run was."""
        for name in _STATE:
            setattr(self, name, state[name])
        self.exposure.offset = state["exposure"]

    @property
    def gauge(self) -> str:
        return _GAUGE if self._options.calibrate == "full" else "nominal world kept"

    @property
    def fixed(self) -> bool:
        """Whether the geometry is left as it is."""
        return self._options.calibrate == "none" or (self._still and (not self._separable or self.static == Static()))

    @property
    def _still(self) -> bool:
        """Whether the gate found that no view moves."""
        return self.decision is not None and self.decision.model == "none"

    @property
    def _alone(self) -> bool:
        """Whether the static part is solved and no view moves for itself."""
        return self._options.calibrate == "static" or self.static_sweeps > 0 or self._still

    def begin_together(self, most: int) -> None:
        """The first sweeps of the run, `most` at most, move no single view."""
        if self._options.calibrate == "full" and self._separable:
            self.static_sweeps = min(STATIC_FIRST, most)

    def settle_yaw(self) -> None:
        """Once views are free and their resolution is good enough to judge: is there a yaw at all?"""
        normals = self._whole_normals
        if self._options.calibrate == "full" and self._yaw_free and normals is not None:
            sigma = sigmas_of_mean(normals, self._scan.frames, self.prior)[3]
            self.static, self._yaw_free = without_doubtful_yaw(
                self._scan.frames, self.static, self.motions, float(sigma)
            )

    def steady(self, here: Level) -> Level:
        """The level as if all views had been exposed alike."""
        return replace(here, images=self.exposure.corrected(here.images))

    def find_exposure(self, descent: Descent, corrected: Frames, measured: Level) -> None:
        """Every view's exposure anew, by its median, which clipping moves in blocks of pixels only."""
        excess = self._excess if self._clipping.deviation and measured.factor > 1 else None
        self.exposure.update(descent.renderer, descent.splats, corrected, measured.images, measured.mask, excess)

    def at(self, nominal: Frames) -> Static:
        """The static part in the pixels of a level."""
        return self.static.binned(self._scan.frames.cols // nominal.cols)

    def corrected(self, nominal: Frames) -> Frames:
        """Static part first, then every view's own."""
        return self.motions.correct(self.at(nominal).apply(nominal))

    def accumulate(self, here: Level, descent: Descent, some: slice = slice(None)) -> Normals:
        """Normal equations of all or some views, with the detector's yaw as long as it is solved."""
        here = self._unclipped(here, descent, some)
        return self._accumulate(here, descent.renderer, descent.splats, self._huber(here), some)

    def _unclipped(self, here: Level, descent: Descent, some: slice = slice(None)) -> Level:
        """The level with all or some views' images as they would be in the mean, had noise not been clipped at zero."""
        if not self._clipping.deviation:
            return here
        images, packed = here.images.copy(), self.corrected(here.nominal).packed()
        for view in range(len(images))[some]:
            images[view] = self.unclipped(here, descent, view, packed[view])
        return replace(here, images=images)

    def unclipped(self, here: Level, descent: Descent, view: int, frame: Array) -> Floats:
        """One view's image so, by what the splats draw at its packed frame. [rows, cols]"""
        if not self._clipping.deviation:
            return here.images[view]
        drawn = np.empty(here.images.shape[1:], np.float32)
        descent.renderer.render(frame, here.nominal.beam == "cone", *descent.splats.arrays(), drawn)
        return here.images[view] - self._excess(view, drawn)

    def _excess(self, view: int, drawn: Floats) -> Floats:
        return self._clipping.excess(drawn, float(self.exposure.offset[view]))

    def _accumulate(
        self, here: Level, renderer: _native.Renderer32, splats: Splats, huber: float, some: slice = slice(None)
    ) -> Normals:
        nominal, motions, images, static = (
            here.nominal[some],
            self.motions[some],
            here.images[some],
            self.at(here.nominal),
        )
        if self._alone or self._yaw_free:
            return accumulate_static(renderer, splats, nominal, static, motions, images, here.mask, huber)
        return accumulate(renderer, splats, motions.correct(static.apply(nominal)), images, here.mask, huber)

    def _softened(self, here: Level, descent: Descent) -> tuple[Normals, float]:
        """Normal equations at the resolution that the splats have, and how many pixels count as one there."""
        frames = self.corrected(here.nominal)
        excess = self._excess if self._clipping.deviation else None
        soft = low_passed(here, frames, descent.renderer, descent.splats, self._threads, excess)
        if soft is None:
            normals = self.accumulate(here, descent)
            self._deviation = _deviation(normals)
            return normals, 1.0
        self._deviation = NORMAL * soft.rough
        huber = max(HUBER * NORMAL * soft.smooth, 1e-12 * float(np.abs(here.images).max()))
        return self._accumulate(soft.here, soft.renderer, descent.splats, huber), soft.shared

    def _huber(self, here: Level) -> float:
        return HUBER * self._deviation or float(np.abs(here.images).max())

    def gate(self, here: Level) -> str | None:
        """Before the finest level: how freely views may move from here on, in a sentence; None if nothing is asked."""
        if self._options.calibrate != "full" or self._options.gate == "off":
            return None
        assert self.normals is not None
        time_s = self._scan.time_s
        scanner = self.at(here.nominal).apply(here.nominal)
        self.decision = gate(
            replace(self.steady(here), nominal=scanner),
            self.motions,
            self.normals,
            self.prior,
            time=None if time_s is None else np.array(time_s),
            seed=self._options.seed,
            threads=self._threads,
        )
        if self.decision.model == "full":
            self.prior = narrowed(self.prior, self.motions, information(self.normals))
        _, self.motions = settle(scanner, self.decision.motions)
        if self._still and self.static.negligible:
            self.static = Static()
        return self.decision.sentence()

    def sweep(self, here: Level, descent: Descent, finest: int, waiting: bool = False) -> dict[str, float]:
        """One Gauss-Newton step of all poses; the splats follow strain and gauge. Returns how far poses moved.

        waiting: turns that a view hardly shows stay as they are, for the splats do not hold yet what shows them."""
        before, static = self.motions, self.at(here.nominal)
        coarse = here.factor > finest or self._sweeps < STATIC_FIRST
        alone = self._alone
        # Four numbers need not see every view of a fine level.
        some = slice(self._sweeps % 3, None, 3) if alone and here.factor <= 2 and len(before) > 40 else slice(None)
        caution = _CAUTION if coarse else 1.0
        if coarse or alone:
            normals = self.accumulate(here, descent, some)
            self._deviation = _deviation(normals)
        else:
            normals, caution = self._softened(here, descent)
        self.normals = normals
        self._sweeps += 1
        self.static_sweeps -= 1
        similarity = Similarity(np.eye(3), np.zeros(3))
        if alone:
            static, strain, _ = step_static(normals, here.nominal[some], static, before[some], self.prior, caution)
        else:
            reach = _REACH_PX * here.pixel_at_isocentre_mm
            limit = np.array([reach / self._radius] * 3 + [3 * reach] * 3)
            turned = float(np.deg2rad(static.yaw_deg))
            motions, strain, yaw = step_full(normals, before, self.prior, limit, caution, turned, self._found, waiting)
            static = replace(static, yaw_deg=static.yaw_deg + float(np.rad2deg(yaw)))
            if self._separable:
                static, motions = split_static(here.nominal, static, motions)
            if self.decision is not None:
                motions = self.decision.restrict(static.apply(here.nominal), motions, normals)
            similarity, self.motions = settle(static.apply(here.nominal), motions)
        means = (descent.splats.means @ (np.eye(3) + strain)).astype(np.float32)
        descent.replace(replace(descent.splats, means=means).moved(similarity))
        binning = self._scan.frames.cols // here.nominal.cols
        static = static.binned(1 / binning)
        column = here.pixel_at_isocentre_mm / binning
        shift, self.static = column * (static.offset_px - self.static.offset_px), static
        omega, tau = (self.motions @ before.inverse()).vectors()
        return {
            "moved_deg": float(np.rad2deg(np.sqrt((omega**2).sum(axis=1).mean()))),
            "moved_mm": float(np.hypot(np.sqrt((tau**2).sum(axis=1).mean()), shift)),
        }

    def find_lost(self, here: Level, descent: Descent, around: bool) -> int:
        """Look for the place of views that stand out against the others (splatcore.lost). Returns how many were found
        for the first time; the splats follow the gauge.

        After a sweep, and only where every view moves for itself; no view twice in vain at one level, but at its end.
        around: the level ends; from places around nominal too, and by what the sweep has left in place of what it
        found."""
        if self._alone or (self.decision is not None and self.decision.model != "full"):
            return 0
        normals = self.accumulate(here, descent) if around else self._whole_normals
        if normals is None:
            return 0
        scanner = replace(here, nominal=self.at(here.nominal).apply(here.nominal))
        lost, most = lost_views(normals)
        sought = lost if around else lost[~self._in_vain[lost]]
        motions, found = find_again(scanner, descent, self.motions, sought, most, self.prior, around=around)
        if len(found):
            similarity, self.motions = settle(scanner.nominal, motions)
            descent.replace(descent.splats.moved(similarity))
        anew = int(np.count_nonzero(~self._found[found]))
        # New arrays: those that a state holds stay as they are.
        self._found, in_vain = self._found.copy(), self._in_vain.copy()
        self._found[found] = in_vain[sought] = True
        in_vain[found] = False
        self._in_vain = in_vain & (not around)
        return anew

    @property
    def _whole_normals(self) -> Normals | None:
        """The last normal equations, unless they are of some views only."""
        whole = self.normals is not None and len(self.normals.pixels) == len(self.motions.rotation)
        return self.normals if whole else None

    def entries(self, corrected: Frames, orientation: dict[str, bool]) -> tuple[dict[str, float], dict[str, float]]:
        """The scanner's constant errors, and the standard deviations of those that were solved."""
        assert self.normals is not None
        nominal = self._scan.frames
        if self._options.calibrate == "full" and not self._separable:
            return {"cor_px": axis_column(corrected)} | orientation, {}
        found = self.static.to_json(nominal) | orientation
        if self._alone:
            return found, as_entries(step_static(self.normals, nominal, self.static, self.motions, self.prior)[2])
        if self._options.calibrate == "full":
            return found, as_entries(sigmas_of_mean(self.normals, nominal, self.prior))
        return found, {}

    def sigmas(self, here: Level, descent: Descent, corrected: Frames) -> tuple[Array, Array]:
        """Standard deviations of omega [views, 3] rad and tau [views, 3] mm, from the images of a steady level; NaN
        where no view was moved, inf where the images do not show the motion."""
        if self._options.calibrate != "full" or self._still:
            return np.full((len(corrected), 3), np.nan), np.full((len(corrected), 3), np.nan)
        covariance = pose_covariance(
            descent.splats,
            self.corrected(here.nominal),
            self._unclipped(here, descent).images,
            here.mask,
            self._huber(here),
            self.prior,
            self._threads,
        )
        omega, tau = np.split(np.sqrt(np.diagonal(covariance, axis1=1, axis2=2)), 2, axis=1)
        if corrected.beam == "parallel":
            # A shift along the ray changes nothing, so any component that shares in it is unbounded.
            tau = np.where(np.abs(self._scan.frames.source) > 1e-3, np.inf, tau)
        if corrected.line:  # likewise out of the plane
            omega[unseen(corrected)[0]] = tau[unseen(corrected)[1]] = np.inf
        return omega, tau


def _deviation(normals: Normals) -> float:
    """Standard deviation of the residual, outliers hardly counted. Line integral."""
    return NORMAL * float(normals.residual_abs.sum() / max(normals.pixels.sum(), 1.0))


def _prior(scan: Scan, half: float) -> Prior:
    stated = scan.tolerance
    rotation_deg, translation = _LOOSE_ROTATION_DEG, _LOOSE_TRANSLATION * half
    if stated and stated.rotation_deg is not None:
        rotation_deg = max(stated.rotation_deg, _TIGHTEST)
    if stated and stated.translation_mm is not None:
        translation = max(stated.translation_mm, _TIGHTEST)
    return Prior(float(np.deg2rad(rotation_deg)), translation)
