"""P8: torque targets keep every limit, too.

With M(q) a + h(q, v) = tau + r, r being what acts beside the drives, one QP takes the torque closest to the wanted
one (in the metric of M^-1, so that its acceleration comes closest in that of M: Gauss' principle of least
constraint) under three groups of bounds. What cannot be kept gives way to the groups before it, as little as may be:

1. the torque caps, and what the torque may change by in a servo period; these are firm;
2. per joint, velocity and acceleration caps, and a bound from which braking ends at the soft limit;
3. what regions and links ahead allow (`lookahead`).

All of these are to be reached within a reaction time, not at once: that is what covers a late tick, the torque's
rate and a wrong model. Where nothing binds, the wanted torque is returned unchanged.
"""

from itertools import compress
from typing import NamedTuple, Protocol

import daqp
import numpy as np

from robotctl.hal.robot import Robot
from robotctl.hal.types import Vector
from robotctl.safety.box import JointBox
from robotctl.safety.lookahead import BRAKE_SHARES, Geometry, Lookahead
from robotctl.safety.proximity import Scene
from robotctl.safety.shaper import SOLVED, Clip

_REACTION_S = 0.02


class Dynamics(Geometry, Protocol):
    """What has to be known of the arm. Arrays are (n,), of matrices (n, n)."""

    damping: Vector
    """Viscous friction, Nms/rad."""

    def mass_matrix(self, position: Vector) -> Vector: ...
    def bias(self, position: Vector, velocity: Vector) -> Vector: ...


class ArmState(NamedTuple):
    """A motion, and the torques that belong to it. Arrays are (n,)."""

    position: Vector
    """rad"""
    velocity: Vector
    """rad/s"""
    effort: Vector
    """Torque that was sent last, Nm."""
    external: Vector
    """What acts beside the drives, Nm."""


class ShapedTorque(NamedTuple):
    """The shaper's answer."""

    torque: Vector
    """(n,), Nm"""
    clip: Clip


class TorqueShaper:
    """Shapes the torques of one robot. Remembers clearances only; every call stands for itself."""

    def __init__(self, robot: Robot, model: Dynamics, scene: Scene | None = None) -> None:
        """Shape for a robot's limits; with a `scene`, for its clearances, too."""
        twin = robot.profile.twin
        self._model = model
        self._dt = robot.period_ns * 1e-9
        self._reaction = _REACTION_S + twin.lag_s + twin.delay_s
        self._cap = robot.limits.torque
        self._step = robot.limits.torque_rate * self._dt
        share, usable = min(BRAKE_SHARES), 1.0 - robot.profile.safety.cap_margin
        self._box = JointBox(robot, self._reaction, usable, brake_share=share, pull=0.25 / self._reaction)
        self._lookahead = Lookahead(robot, model, self._reaction, scene)

    def push(self, state: ArmState, wanted: Vector) -> ShapedTorque:
        """Return the torque for the next servo period of an arm that moves as `state` tells.

        Args:
            state: measured; its external torque as observed.
            wanted: torque to come as close to as the limits allow (n,), Nm, finite.
        """
        inertia, load = self._dynamics(state)
        mobility = np.asarray(np.linalg.inv(inertia), dtype=np.float64)
        return self._closest(state, wanted, mobility, load)

    def _dynamics(self, state: ArmState) -> tuple[Vector, Vector]:
        """Return M (n, n) and h - r (n,), so that M a + h - r is the mean torque of a servo period."""
        position, velocity, _, external = state
        middle = position + 0.5 * self._dt * velocity
        # Viscous friction is taken at the period's end: a joint that it dominates settles within the period.
        inertia = self._model.mass_matrix(middle) + self._dt * np.diag(self._model.damping)
        return inertia, self._model.bias(middle, velocity) + self._model.damping * velocity - external

    def _closest(self, state: ArmState, wanted: Vector, mobility: Vector, load: Vector) -> ShapedTorque:
        n, velocity, box = len(wanted), state.velocity, self._box
        normals, bounds, flags = self._lookahead.rows(state.position, velocity)
        slowest, fastest = box.bounds(state.position, velocity)
        rows = np.vstack([mobility, normals @ mobility])
        # With a = rows @ (torque - load), bounds on accelerations become bounds on the torque.
        free = rows @ load
        least, most = (slowest - velocity) / self._reaction, (fastest - velocity) / self._reaction
        lower = np.concatenate([np.maximum(-self._cap, state.effort - self._step), least + free[:n]])
        lower = np.concatenate([lower, np.full(len(bounds), -np.inf)])
        upper = np.concatenate([np.minimum(self._cap, state.effort + self._step), most + free[:n], bounds + free[n:]])
        result = np.concatenate([wanted, rows @ wanted])
        broken = (result > upper) | (result < lower)
        if not broken.any():
            return ShapedTorque(wanted, Clip.NONE)
        clip = Clip.TORQUE if broken[:n].any() else Clip.NONE
        for flag in compress(flags, broken[2 * n :]):
            clip |= flag
        following = velocity + self._reaction * (result[n:] - free)[:n]
        clip |= _passed(velocity, following, slowest, fastest, box)
        torque = _solve(wanted, mobility, rows, lower, upper)
        if torque is None:
            braking = np.minimum(np.maximum(-velocity, -box.step), box.step) / self._reaction
            torque = load + np.linalg.solve(mobility, braking)
        return ShapedTorque(np.minimum(np.maximum(torque, lower[:n]), upper[:n]), clip)


def _solve(wanted: Vector, mobility: Vector, rows: Vector, lower: Vector, upper: Vector) -> Vector | None:
    """Return the torque closest to the wanted one: itself bounded first, then the result of each row."""
    n = len(wanted)
    sense = np.zeros(len(upper), dtype=np.int32)  # below the first level they give way all the same
    levels = np.array([n, 2 * n, len(upper)], dtype=np.int32)
    torque, _, flag, _ = daqp.solve(mobility, -mobility @ wanted, rows, upper, lower, sense, levels)
    return torque if flag in SOLVED else None


def _passed(velocity: Vector, following: Vector, slowest: Vector, fastest: Vector, box: JointBox) -> Clip:
    """Return which limits of joints a step from `velocity` to `following` passes, given the bounds of that step."""
    most = np.minimum(box.velocity_cap, velocity + box.step)
    least = np.maximum(-box.velocity_cap, velocity - box.step)
    clip = Clip.NONE
    if (np.abs(following) > box.velocity_cap).any():
        clip |= Clip.VELOCITY
    if (np.abs(following - velocity) > box.step).any():
        clip |= Clip.ACCELERATION
    if (((following > fastest) & (fastest < most)) | ((following < slowest) & (slowest > least))).any():
        clip |= Clip.POSITION
    return clip
