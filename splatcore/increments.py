"""The paper's poses: an additive increment of every view's quaternion and translation, moved by Adam.

World to camera is W x + t with W = Rot(q0 + dq), t = t0 + dt, q0 and t0 nominal; the origin is the isocentre, so that
a turn does not move the object's middle. Where the nominal one is W0 x + t0 this is the object moved by
R = W0' W, tau = W0' dt before it is seen: t0 drops out, and parallel beams need no other form.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from splatcore.geometry import Array, Frames, RigidMotions, quaternion_from_rotation

RATE, RATE_END = 2e-4, 2e-5  # quaternion components and half widths of the volume
_KEEP, _KEEP_SQUARE, _TINY = 0.9, 0.999, 1e-15


class Increments:
    """dq [views, 4] and dt [views, 3], with Adam's moments. A view's numbers move only when it is drawn."""

    def __init__(self, nominal: Frames, steps: int, faster: float = 1.0) -> None:
        """steps: of the whole run, over which the rate falls exponentially; faster: multiplies the rate."""
        self._nominal, self._packed = nominal, nominal.packed()
        self._cone = nominal.beam == "cone"
        self._axes = nominal.axes()  # W0, rows are the camera's axes
        self._start = np.stack([quaternion_from_rotation(turn) for turn in self._axes])
        self.values = np.zeros((len(nominal), 7))  # dq, dt
        self._moments = np.zeros((2, len(nominal), 7))
        self._visits = np.zeros(len(nominal), np.int64)
        self._steps, self._faster = max(steps, 1), faster

    def state(self) -> dict[str, Any]:
        """For a checkpoint."""
        return {"values": self.values, "moments": self._moments, "visits": self._visits}

    def load(self, state: dict[str, Any]) -> None:
        self.values, self._moments, self._visits = state["values"], state["moments"], state["visits"]

    def motion(self, view: int) -> tuple[Array, Array]:
        """The object's motion (R [3, 3], tau [3]) that the view's increment amounts to."""
        turn = rotation(self._start[view] + self.values[view, :4])
        back = self._axes[view].T
        return back @ turn, back @ self.values[view, 4:]

    def motions(self) -> RigidMotions:
        """Of all views."""
        pairs = [self.motion(view) for view in range(len(self.values))]
        return RigidMotions(np.stack([turn for turn, _ in pairs]), np.stack([shift for _, shift in pairs]))

    def frame(self, view: int) -> Array:
        """The corrected frame as the core takes it. [4, 3]"""
        turn, shift = self.motion(view)
        moved = self._packed[view].copy()
        moved[1] -= shift
        if self._cone:
            moved[0] -= shift
        return moved @ turn

    def chain(self, view: int, v_motion: Array) -> Array:
        """dL/d(dq, dt) [7] from dL/d(omega, tau) [6] of a motion of the object before the present pose.

        W (x + omega x x + tau) + t: the camera sees a turn by W omega and a shift by W tau; and q turns by
        2 vec(dq conj(q)) / |q|.
        """
        quat = self._start[view] + self.values[view, :4]
        size = np.linalg.norm(quat)
        w, v = quat[0] / size, quat[1:] / size
        turn = rotation(quat)
        twist = turn @ v_motion[:3]
        gradient = np.empty(7)
        gradient[0] = -2 * (v @ twist) / size
        gradient[1:4] = 2 * (w * twist - np.cross(v, twist)) / size
        gradient[4:] = turn @ v_motion[3:]
        return gradient

    def step(self, view: int, v_motion: Array, step: int) -> None:
        """One Adam step of one view; step counts from 0 over the whole run."""
        gradient = self.chain(view, v_motion)
        self._visits[view] += 1
        first, second = self._moments[:, view]  # views into the moments
        first += (1 - _KEEP) * (gradient - first)
        second += (1 - _KEEP_SQUARE) * (gradient * gradient - second)
        visits = int(self._visits[view])
        rate = self._faster * RATE * (RATE_END / RATE) ** (step / self._steps)
        size = np.sqrt(second / (1 - _KEEP_SQUARE**visits)) + _TINY
        self.values[view] -= rate / (1 - _KEEP**visits) * first / size


def rotation(quat: Array) -> Array:
    """Rot(q / |q|), w x y z. [4] -> [3, 3]"""
    w, x, y, z = (quat / np.sqrt(quat @ quat)).tolist()
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
