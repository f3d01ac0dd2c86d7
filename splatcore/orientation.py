"""Does the turntable turn the way the scan says, and are rows rows? Found by trying, at low resolution.

Mirrored columns are a reversed rotation of the mirrored object, mirrored rows the mirrored object itself. So of
(reversed, mirrored columns, mirrored rows) the images show one thing, whether the first two differ; and besides it
whether rows and columns are exchanged. Four candidates in all. Each gets a short reconstruction with free poses, which
takes static errors and jitter out of the comparison (a centre of rotation a few pixels off misleads one with fixed
poses): what is left is what no pose can mend. The geometry is changed only where that is clearly less.

A round object looks the same either way, and so does any object in a parallel beam, where mirrored columns are the
object turned by half a circle. Then the scan stays as given.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from splatcore.descent import Descent
from splatcore.gauge import settle
from splatcore.geometry import Frames, RigidMotions
from splatcore.options import Options
from splatcore.poses import Prior, accumulate, step_full
from splatcore.pyramid import Level, level
from splatcore.scan import Scan
from splatcore.splats import Similarity
from splatcore.static import Static, accumulate_static, step_static
from splatcore.trial import try_frames

_PIXELS = 32  # along the shorter side of the detector: enough to see an object turn
_MOST_VIEWS = 96
_FEWEST_VIEWS = 8
_SPLATS = 1_500
_EPOCHS = 2  # before the first sweep
_SWEEPS = 10  # of the poses, an epoch between them
_TOGETHER = 3  # the first of them move all views together: the centre of rotation may be far off
_FAR_OFF = 5.0  # how much farther than a view's own place
_LOOK_AFTER, _FAR = 4, 1.3  # after five sweeps what leaves more than this times the best is given up
_CLEAR = 0.93  # times the given geometry's residual: less than this is evidence. Round objects come within 0.99
_FAINTEST = 1e-30  # line integral
_PRIOR_DEG, _PRIOR_WIDTH, _CAUTION, _REACH_PX = 5.0, 0.1, 1000.0, 1.5


@dataclass(frozen=True)
class Orientation:
    """How the stored images lie against the scan's frames."""

    reversed: bool = False  # the turntable turns the other way, or columns are mirrored: the same to the images
    transposed: bool = False  # rows are columns

    def apply(self, given: Frames) -> Frames:
        """The frames of the stored images."""
        turned = reversed_rotation(given) if self.reversed else given
        return transposed(turned) if self.transposed else turned

    @property
    def name(self) -> str:
        return {
            (False, False): "as given",
            (True, False): "rotation reversed",
            (False, True): "transposed",
            (True, True): "transposed and rotation reversed",
        }[self.reversed, self.transposed]


@dataclass(frozen=True)
class Verdict:
    """What the trials said."""

    found: Orientation
    residual: dict[str, float]  # share of the images' RMS left over, by name of the candidate
    tried: bool  # false: an option settles it, or there is too little to see
    reason: str = ""  # where not tried: why

    def entries(self) -> dict[str, bool]:
        """For `static` of poses.json: only what differs from the given geometry."""
        named = {"rotation_reversed": self.found.reversed, "transposed": self.found.transposed}
        return {name: True for name, value in named.items() if value}


def reversed_rotation(frames: Frames) -> Frames:
    """The same scanner with its angles negated: the world mirrored in y, the columns mirrored back."""
    mirror = np.array([1.0, -1.0, 1.0])
    return replace(
        frames,
        source=frames.source * mirror,
        detector_center=frames.detector_center * mirror,
        u=-frames.u * mirror,
        v=frames.v * mirror,
    )


def transposed(frames: Frames) -> Frames:
    """Frames of the images with rows and columns exchanged, for square detectors alone."""
    return replace(frames, u=frames.v, v=frames.u)


def mirrored(frames: Frames, columns: bool, rows: bool) -> Frames:
    """Frames of images stored mirrored. An offset of the detector stays where it is in the world."""
    return replace(frames, u=-frames.u if columns else frames.u, v=-frames.v if rows else frames.v)


def oriented(scan: Scan, options: Options, threads: int) -> tuple[Scan, Verdict]:
    """The scan with its frames turned the way its images lie, as options say and trials find."""
    if options.rotation == "auto":
        mirrored_scan = read_as(scan, options, Orientation())
        verdict = find_orientation(mirrored_scan, options.seed, threads)
    else:
        verdict = Verdict(Orientation(reversed=options.rotation == "reversed"), {}, False, "the options settle it")
    return read_as(scan, options, verdict.found), verdict


def read_as(scan: Scan, options: Options, found: Orientation) -> Scan:
    """The scan with its frames turned the way its images lie, as options say and an earlier trial found."""
    return replace(scan, frames=found.apply(mirrored(scan.frames, options.flip_u, options.flip_v)))


def find_orientation(scan: Scan, seed: int, threads: int) -> Verdict:
    """Try the four candidates. About a second on one core, whatever the size of the scan."""
    given = Orientation()
    if len(scan.frames) < _FEWEST_VIEWS:
        return Verdict(given, {}, False, f"{len(scan.frames)} views are too few")
    if scan.frames.beam == "parallel":
        candidates = [given, Orientation(transposed=True)]  # half a turn of the object is the other parity
    else:
        candidates = [given, Orientation(reversed=True), Orientation(transposed=True), Orientation(True, True)]
    if not _square(scan.frames):  # images of another shape than the detector are refused when they are read
        candidates = [c for c in candidates if not c.transposed]
    if len(candidates) == 1:
        return Verdict(given, {}, False, "a parallel beam cannot tell")
    here = _coarse(scan)
    scale = float(np.sqrt((here.images.astype(np.float64) ** 2).mean()))
    if not float(here.images.max()) > _FAINTEST:  # the reconstruction itself says so
        return Verdict(given, {}, False, "the images are empty")
    trials = {c: _Trial(here, c.apply(here.nominal), scan, seed, threads) for c in candidates}
    for sweep in range(_SWEEPS):
        for trial in trials.values():
            trial.sweep()
        if sweep == _LOOK_AFTER:
            best = min(trial.residual for trial in trials.values())
            for far in [c for c in trials if trials[c].residual > _FAR * best]:
                trials[far].give_up()
            if sum(trial.alive for trial in trials.values()) == 1:
                break
    left = {c.name: trial.residual / scale for c, trial in trials.items()}
    winner = min(candidates, key=lambda c: left[c.name])
    return Verdict(winner if left[winner.name] < _CLEAR * left[given.name] else given, left, True)


def finding(verdict: Verdict, options: Options) -> dict[str, Any]:
    """For the report: what was found, in words, with the numbers."""
    found, left = verdict.found, verdict.residual
    evidence: dict[str, Any] = {f"residual {name}": value for name, value in left.items()}
    if not verdict.tried:
        severity = "note"
        text = f"The turning sense was not tested: {verdict.reason}."
        if found.reversed:
            text = "The turning sense was reversed, as the options ask."
    elif found != Orientation():
        severity = "warning"
        parts = []
        if found.transposed:
            parts.append("Rows and columns of the images are exchanged")
        if found.reversed:
            parts.append("The turntable turns the other way, or the columns are mirrored: the two look the same")
        text = ". ".join(parts)
        text += f". As given {left['as given']:.1%} of the images' signal cannot be explained, read this way "
        text += f"{left[found.name]:.1%}; the reconstruction reads them this way."
        if found.reversed:
            text += (
                " If it is the columns, the volume is the mirror image of the object: set flip_u and rotation given."
            )
    else:
        severity = "ok"
        others = [value for name, value in left.items() if name != "as given"]
        mine = left["as given"]
        if others and min(others) * _CLEAR < mine:
            severity = "note"
            text = (
                f"The images do not say clearly how they lie: read another way, {min(others):.2%} of their signal "
                f"cannot be explained, as given {mine:.2%}. They were taken as given. A round object looks the same "
                "whichever way the turntable turns."
            )
        else:
            text = "The turntable turns as stated, and rows are rows: every other reading of the images fits worse."
    if options.flip_u or options.flip_v:
        which = " and ".join(name for name, on in (("columns", options.flip_u), ("rows", options.flip_v)) if on)
        text += f" The {which} were taken as mirrored, as the options ask."
    return {"name": "orientation of the images", "severity": severity, "text": text, "evidence": evidence}


def _square(frames: Frames) -> bool:
    width, height = (np.linalg.norm(step, axis=1) for step in (frames.u, frames.v))
    return frames.rows == frames.cols and bool(np.allclose(width, height, rtol=1e-6))


def _coarse(scan: Scan) -> Level:
    """The scan at the lowest useful resolution, views thinned out evenly."""
    views = np.unique(np.linspace(0, len(scan.frames) - 1, min(len(scan.frames), _MOST_VIEWS)).astype(int))
    thin = replace(scan, frames=scan.frames[views], projections=scan.projections[views])
    return level(thin, max(1, min(scan.frames.rows, scan.frames.cols) // _PIXELS))


class _Trial:
    """A low-resolution reconstruction that moves its views as it likes. What is left is what no pose can mend."""

    def __init__(self, here: Level, nominal: Frames, scan: Scan, seed: int, threads: int) -> None:
        self._here, self._nominal, self._rng = here, nominal, np.random.default_rng(seed)
        views, half = len(nominal), float(scan.volume.half_extent_mm().max())
        reach = _REACH_PX * here.pixel_at_isocentre_mm
        self._limit = np.array([reach / half] * 3 + [3 * reach] * 3)
        self._prior = Prior(float(np.deg2rad(_PRIOR_DEG)), _PRIOR_WIDTH * half)
        self._static, self._motions, self._sweeps = Static(), RigidMotions.identity(views), 0
        self._huber = float(here.images.max())
        self._descent = try_frames(
            here, nominal, np.arange(views), seed, threads, steps=_EPOCHS * views, of=(_EPOCHS + _SWEEPS) * views,
            splats=_SPLATS,
        )  # fmt: skip
        self.residual = _residual_rms(self._descent, here, nominal)
        self.alive = self._descent is not None

    def give_up(self) -> None:
        """Keep the residual, free the rest."""
        self._descent, self.alive = None, False

    def sweep(self) -> None:
        """All poses once, together or each for itself, then every view once."""
        if self._descent is None:
            return
        here, descent, nominal = self._here, self._descent, self._nominal
        scanner, self._sweeps = self._static.apply(nominal), self._sweeps + 1
        if self._sweeps <= _TOGETHER:
            normals = accumulate_static(
                descent.renderer, descent.splats, nominal, self._static, self._motions, here.images, here.mask,
                self._huber, yaw=False,
            )  # fmt: skip
            wide = replace(self._prior, translation=_FAR_OFF * self._prior.translation)
            self._static, strain, _ = step_static(normals, nominal, self._static, self._motions, wide, _CAUTION)
            scanner, similarity = self._static.apply(nominal), Similarity(np.eye(3), np.zeros(3))
        else:
            frames = self._motions.correct(scanner)
            normals = accumulate(descent.renderer, descent.splats, frames, here.images, here.mask, self._huber)
            motions, strain, _ = step_full(normals, self._motions, self._prior, self._limit, _CAUTION)
            similarity, self._motions = settle(scanner, motions)
        self._huber = max(2.5 * float(normals.residual_abs.sum() / max(normals.pixels.sum(), 1.0)), 1e-30)
        means = (descent.splats.means @ (np.eye(3) + strain)).astype(np.float32)
        descent.replace(replace(descent.splats, means=means).moved(similarity))
        frames = self._motions.correct(scanner)
        packed = frames.packed()
        for view in self._rng.permutation(len(nominal)):
            descent.step(packed[view], nominal.beam == "cone", here.images[view], here.mask)
        self.residual = _residual_rms(descent, here, frames)


def _residual_rms(descent: Descent | None, here: Level, frames: Frames) -> float:
    """RMS residual over all good pixels; without a reconstruction that of the images themselves."""
    image = np.zeros((frames.rows, frames.cols), np.float32)
    weight = np.ones_like(image) if here.mask is None else here.mask
    squares = 0.0
    for k, frame in enumerate(frames.packed()):
        if descent is not None:
            descent.renderer.render(frame, frames.beam == "cone", *descent.splats.arrays(), image)
        squares += float((weight * (image - here.images[k]).astype(np.float64) ** 2).sum())
    return float(np.sqrt(squares / max(len(frames) * float(weight.sum()), 1e-30)))
