"""The scanner's constant errors: four numbers that all views share, and how far each shows (docs/method/static.md).

Seen from a view, with u its columns, v its rows and n = u x v:

    axis pitch   the rotation axis leans along the beam: the object turned about u, at the isocentre
    roll         the detector turned about n, which is the object turned the other way
    cor          the detector moved along u: the column on which the axis falls
    yaw          the detector turned about v, through its own centre

Pitch and roll are rigid motions of the object in the view's axes. So is the better part of cor: moving the detector
along u is turning source and detector together about the source, then the detector alone back about v. What is not
rigid is yaw alone, and its derivative is a difference of two images.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from splatcore import _native
from splatcore.geometry import Array, Frames, RigidMotions, rotation_from_vector
from splatcore.poses import Normals, Prior, accumulate
from splatcore.splats import Floats, Splats

NAMES = ("cor_px", "roll_deg", "axis_pitch_deg", "yaw_deg")
_STEP = np.array([1e-3, 1e-3, 1e-3, 1e-3])  # px, deg: differences of exact group elements in float64
_REACH_DEG = (3.0, 3.0, 1.0)  # longest step of roll, pitch, yaw; of cor, a sixteenth of the detector
_YAW_TOLD_DEG = 0.25  # with free views a smaller yaw is not told from none at low resolution; measured errors: 0.1
_YAW_TOLD_SIGMAS = 10.0
# Below these (columns, degrees) a constant error at half resolution is not told from none: what was found there where
# nothing was wrong was at most 0.002, 0.0015, 0.051 and 0.0003 at 128^3, and a yaw of 0.07 to 1.1 at 40^3:
# what is larger is solved on.
_TOLD = (0.02, 0.005, 0.07, 0.1)
_YAW_STEP = 0.01  # rad; difference of two float32 images: large enough to stand above their rounding


@dataclass(frozen=True)
class Static:
    """Constant errors against the nominal scanner. All zero: the scanner is as stated."""

    offset_px: float = 0.0  # of the detector along u, in columns; the axis falls that much to the left of nominal
    roll_deg: float = 0.0  # of the detector about u x v
    axis_pitch_deg: float = 0.0  # of the rotation axis about u
    yaw_deg: float = 0.0  # of the detector about v; always zero for a parallel beam, where it does not show

    def vector(self) -> Array:
        """(offset px, roll, pitch, yaw deg). [4]"""
        return np.array([self.offset_px, self.roll_deg, self.axis_pitch_deg, self.yaw_deg])

    @classmethod
    def of(cls, vector: Array) -> Static:
        """The inverse of `vector`."""
        return cls(*(float(value) for value in vector))

    @property
    def negligible(self) -> bool:
        """Whether an error this small, found at half resolution, is not told from none."""
        return bool((np.abs(self.vector()) < _TOLD).all())

    def to_json(self, nominal: Frames) -> dict[str, float]:
        """As poses.json holds them: `cor_px` is the column of the axis, the others are degrees from nominal."""
        column = axis_column(self.apply(nominal))
        return dict(zip(NAMES, (column, self.roll_deg, self.axis_pitch_deg, self.yaw_deg), strict=True))

    def binned(self, factor: float) -> Static:
        """The same errors of a detector whose pixels are `factor` times as large."""
        return replace(self, offset_px=self.offset_px / factor)

    def apply(self, nominal: Frames) -> Frames:
        """The frames of a scanner with these errors. The nominal world, and for a cone beam without pitch the nominal
        sources, are kept."""
        return self.motions(nominal).correct(self.mounted(nominal))

    def motions(self, nominal: Frames) -> RigidMotions:
        """The rigid part, as a motion of the object seen by `mounted`: pitch, then the swing, then roll."""
        axes, views = nominal.axes(), len(nominal)
        still = np.zeros((views, 3))
        pitch = RigidMotions(_turn(axes[:, 0], np.deg2rad(self.axis_pitch_deg)), still)
        roll = RigidMotions(_turn(axes[:, 2], -np.deg2rad(self.roll_deg)), still)
        if nominal.beam == "parallel":
            return roll @ RigidMotions(_turn(axes[:, 0], 0.0), -self.offset_px * nominal.u) @ pitch
        turn = _turn(axes[:, 1], self._swing(nominal))
        swing = RigidMotions(turn, nominal.source - np.einsum("vij,vj->vi", turn, nominal.source))
        return roll @ swing @ pitch

    def turned(self, nominal: Frames) -> float:
        """How far `mounted` turns the detector, rad: the yaw, and what takes back the swing."""
        return float(np.deg2rad(self.yaw_deg)) + self._swing(nominal)

    def mounted(self, nominal: Frames, more: float = 0.0) -> Frames:
        """The detector turned about its own v (by `more` rad more): what no motion of the object can stand for."""
        if nominal.beam == "parallel":
            return nominal
        turn = _turn(nominal.axes()[:, 1], self.turned(nominal) + more)
        return replace(nominal, u=np.einsum("vij,vj->vi", turn, nominal.u), v=np.einsum("vij,vj->vi", turn, nominal.v))

    def _swing(self, nominal: Frames) -> float:
        """The angle about the source, rad, that moves the axis by `offset_px` columns. One for all views, so that a
        change of it is one motion in the views' axes: medians where distances differ."""
        reach = float(np.median(np.linalg.norm(nominal.u, axis=1) / _distance(nominal)))
        return -float(np.arcsin(np.clip(self.offset_px * reach, -0.5, 0.5)))


def _distance(nominal: Frames) -> Array:
    """From source to the detector's plane, mm. [views]"""
    return np.einsum("vi,vi->v", nominal.axes()[:, 2], nominal.detector_center - nominal.source)


def _turn(axis: Array, angle: float | Array) -> Array:
    return rotation_from_vector(axis * np.broadcast_to(np.asarray(angle), len(axis))[:, None])


def accumulate_static(
    renderer: _native.Renderer32,
    splats: Splats,
    nominal: Frames,
    static: Static,
    motions: RigidMotions,
    targets: Floats,
    mask: Floats | None,
    huber: float,
    yaw: bool = True,
) -> Normals:
    """Normal equations of every view with the detector's yaw as thirteenth direction, in rad. [views, 13, 13]
    yaw: false leaves it where it is, at less than half the cost.

    The derivative image Y of the yaw is a central difference of two renders. Its products with the twelve directions
    come from the core: called with the target I - Y and the present weights as mask, the gradient is sum w D Y.
    """
    views = len(nominal)
    hessian, gradient, sums = np.zeros((views, 13, 13)), np.zeros((views, 13)), np.zeros((views, 4))
    cone = nominal.beam == "cone"
    rigid = static.motions(nominal) @ motions
    if not (yaw and observable(nominal)[3]):
        plain = accumulate(renderer, splats, rigid.correct(static.mounted(nominal)), targets, mask, huber)
        hessian[:, :12, :12], gradient[:, :12] = plain.hessian, plain.gradient
        return replace(plain, hessian=hessian, gradient=gradient)
    packed, before, after = (
        rigid.correct(static.mounted(nominal, angle)).packed() for angle in (0.0, -_YAW_STEP, _YAW_STEP)
    )
    image, left, right = (np.empty((nominal.rows, nominal.cols), np.float32) for _ in range(3))
    block, column, unused = np.zeros((12, 12)), np.zeros(12), np.zeros((12, 12))
    for k in range(views):
        view = targets[k]
        sums[k] = renderer.motion_normal(packed[k], cone, *splats.arrays(), view, mask, huber, block, column)
        hessian[k, :12, :12], gradient[k, :12] = block, column
        renderer.render(packed[k], cone, *splats.arrays(), image)
        renderer.render(before[k], cone, *splats.arrays(), left)
        renderer.render(after[k], cone, *splats.arrays(), right)
        turn = (right - left) / np.float32(2 * _YAW_STEP)
        residual = image - view
        weight = np.minimum(np.float32(huber) / np.maximum(np.abs(residual), np.float32(1e-30)), np.float32(1))
        if mask is not None:
            weight *= mask
        scale = np.float32(1 / max(float(np.abs(turn).max()), 1e-30))
        renderer.motion_normal(
            packed[k], cone, *splats.arrays(), image - turn * scale, weight, float(np.float32(1e30)), unused, column
        )
        hessian[k, 12, :12] = hessian[k, :12, 12] = column / scale
        hessian[k, 12, 12] = np.sum(weight * turn * turn, dtype=np.float64)
        gradient[k, 12] = np.sum(weight * turn * residual, dtype=np.float64)
    return Normals(hessian, gradient, *sums.T)


def tangents(nominal: Frames, static: Static, motions: RigidMotions) -> Array:
    """How each of the four numbers moves a view: omega, tau (of the world, before the pose) and the detector's yaw,
    per px and degree. Differences of exact motions. [views, 7, 4]"""
    pose = static.motions(nominal) @ motions
    back = pose.inverse()
    out = np.zeros((len(nominal), 7, 4))
    for k in range(4):
        step = np.eye(4)[k] * _STEP
        near, far = Static.of(static.vector() - step), Static.of(static.vector() + step)
        one, two = ((back @ s.motions(nominal) @ motions).vectors() for s in (near, far))
        out[:, :3, k] = (two[0] - one[0]) / (2 * _STEP[k])
        out[:, 3:6, k] = (two[1] - one[1]) / (2 * _STEP[k])
        out[:, 6, k] = (far.turned(nominal) - near.turned(nominal)) / (2 * _STEP[k])
    return out


def observable(frames: Frames) -> Array:
    """Which of the four numbers are solved: those that show well enough (`observability.sensitivity`). One row shows
    cor alone; one column, which is the axis itself, nothing. [4] of bool"""
    area = not frames.line
    return np.array([frames.cols > 1, area, area, area and frames.beam == "cone"])


def step_static(
    normals: Normals, nominal: Frames, static: Static, motions: RigidMotions, prior: Prior, caution: float = 1.0
) -> tuple[Static, Array, Array]:
    """The four numbers after one Gauss-Newton step together with the object's strain, the strain [3, 3] that the means
    must follow, and one standard deviation of each number (inf: not observable) [4].

    normals: of `accumulate_static`. caution: how many pixels count as one independent measurement.
    """
    noise = caution * normals.noise[:, None]
    into = np.zeros((len(nominal), 13, 10))
    into[:, [0, 1, 2, 3, 4, 5, 12], :4] = tangents(nominal, static, motions)
    into[:, 6:12, 4:] = np.eye(6)
    hessian = np.einsum("vij,vik,vkl->jl", into, normals.hessian / noise[:, None], into)
    gradient = np.einsum("vij,vi->j", into, normals.gradient / noise)
    free = np.concatenate([observable(nominal), np.ones(6, bool)])
    degrees = np.rad2deg(prior.rotation)
    width = np.array([prior.translation / _column_mm(nominal), degrees, degrees, degrees])
    precision = np.concatenate([1 / width**2, np.full(6, 1 / prior.strain**2)])
    offset = np.concatenate([static.vector(), np.zeros(6)])
    system = hessian + np.diag(precision)
    covariance = np.zeros((10, 10))
    covariance[np.ix_(free, free)] = np.linalg.inv(system[np.ix_(free, free)])
    step = -covariance @ (gradient + precision * offset)
    step[:4] /= max(1.0, float(np.abs(step[:4] / [nominal.cols / 16, *_REACH_DEG]).max()))
    xx, yy, zz, yz, xz, xy = np.clip(step[4:], -0.01, 0.01)
    sigma = np.where(free[:4], np.sqrt(np.diag(covariance)[:4]), np.inf)
    return Static.of(static.vector() + step[:4]), np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]), sigma


def sigmas_of_mean(normals: Normals, nominal: Frames, prior: Prior) -> Array:
    """One standard deviation of the static part where every view is free as well: it is the mean of what the views
    share, so its variance is theirs over their number. The yaw is marginalised over all poses and the strain; inf where
    the normal equations do not hold it. The volume is taken as known. [4] px, degrees"""
    noise, views = normals.noise[:, None, None], len(nominal)
    blocks = normals.rigid / noise + np.diag(prior.precision())
    covariance = np.linalg.inv(blocks)
    axes = np.zeros((views, 6, 6))
    axes[:, :3, :3] = axes[:, 3:, 3:] = nominal.axes()
    spread = np.sqrt(np.einsum("vij,vjk,vik->i", axes, covariance, axes)) / views
    degrees = np.rad2deg(spread[:3])
    sigma = np.array([spread[3] / _column_mm(nominal), degrees[2], degrees[0], np.inf])
    if normals.hessian.shape[1] > 12 and nominal.beam == "cone":
        shared, mixed = normals.hessian[:, 6:, 6:] / noise, normals.hessian[:, :6, 6:] / noise
        schur = shared.sum(axis=0) - np.einsum("vij,vik,vkl->jl", mixed, covariance, mixed)
        schur += np.diag([1 / prior.strain**2] * 6 + [1 / prior.rotation**2])
        sigma[3] = np.rad2deg(np.sqrt(np.linalg.inv(schur)[6, 6]))
    return np.where(observable(nominal), sigma, np.inf)


def _column_mm(nominal: Frames) -> float:
    """A column of the detector seen at the isocentre."""
    return float(np.median(np.linalg.norm(nominal.u, axis=1) * nominal.isocentre_depth()))


def without_doubtful_yaw(
    nominal: Frames, static: Static, motions: RigidMotions, sigma_deg: float
) -> tuple[Static, bool]:
    """For scans whose views are free as well: the static part without a yaw that is not clearly seen, and whether it
    is. A yaw that is wrong by a tenth of a degree puts every source a millimetre off.

    sigma_deg: one standard deviation, the volume taken as known; errors at low resolution are several times that. What
    "no yaw" means depends on why the axis is off its column. Where the views scatter so much along u that their mean
    may be as far off by chance, the detector did not move against the source, and `turned` is zero; else it is the
    detector that is off its place, and its normal is the stated one."""
    if abs(static.yaw_deg) > max(_YAW_TOLD_DEG, _YAW_TOLD_SIGMAS * sigma_deg):
        return static, True
    if nominal.beam == "parallel":
        return static, False
    along = np.einsum("vi,vi->v", nominal.axes()[:, 0], motions.translation)
    by_chance = 3 * float(np.std(along)) / np.sqrt(len(nominal))
    swing = static._swing(nominal)
    rigid = abs(swing) * _lever(nominal) < by_chance
    return replace(static, yaw_deg=-float(np.rad2deg(swing)) if rigid else 0.0), False


def _lever(nominal: Frames) -> float:
    """From source to isocentre along the detector's normal, mm."""
    return float(np.median(np.einsum("vi,vi->v", nominal.axes()[:, 2], -nominal.source)))


def split_static(nominal: Frames, static: Static, motions: RigidMotions) -> tuple[Static, RigidMotions]:
    """The same frames with all that views share in the static part: afterwards the mean over views, in each view's
    own axes, of the rotations about u and about u x v and of the shift along u is zero.

    The composition is exact: `new_motions.correct(new_static.apply(nominal))` are the old frames. A shift of the object
    along u is cor and a little yaw, since the detector does not move against the source.
    Of a line of pixels only the shift is split off.
    """
    axes, total = nominal.axes(), static.motions(nominal) @ motions
    mounted, rest, every = static.turned(nominal), motions, observable(nominal)
    cone = nominal.beam == "cone"
    per_px = float(np.median(np.linalg.norm(nominal.u, axis=1)))
    lever = _lever(nominal) if cone else 1.0
    for _ in range(20):
        omega, tau = (np.einsum("vij,vj->vi", axes, part).mean(axis=0) for part in rest.vectors())
        shift = tau[0]
        if cone:  # swing by shift / lever; the detector keeps its angle to the line from source to axis
            swing = static._swing(nominal) + shift / lever
            offset = -np.sin(swing) * float(np.median(_distance(nominal))) / per_px
        else:
            offset = static.offset_px - shift / per_px
        static = replace(
            static,
            offset_px=float(offset),
            roll_deg=static.roll_deg - float(np.rad2deg(omega[2])) * bool(every[1]),
            axis_pitch_deg=static.axis_pitch_deg + float(np.rad2deg(omega[0])) * bool(every[2]),
        )
        if cone:
            static = replace(static, yaw_deg=float(np.rad2deg(mounted - static._swing(nominal))))
        rest = static.motions(nominal).inverse() @ total
        if abs(shift) + np.abs(omega[[0, 2]]).max() < 1e-14:
            break
    return static, rest


def axis_column(frames: Frames) -> float:
    """`cor_px`: the detector column on which the rotation axis falls at the isocentre's height, mean over views."""
    return float(frames.project(np.zeros((1, 3)))[:, 0, 0].mean())
