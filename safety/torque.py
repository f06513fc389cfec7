"""P8: torque targets keep every limit, too, and the arm can be stopped whatever its model is wrong by.

With M(q) a + h(q, v) = tau + r, r being what the momentum observer finds, one QP takes the torque that comes closest
to the wanted one (in the metric of M^-1, so that its acceleration comes closest in that of M: Gauss' principle of
least constraint) under three groups of bounds, of which a later one gives way to those before it:

1. the torque caps, and what the torque may change by in a servo period;
2. per joint, velocity and acceleration caps, and a bound from which braking ends at the soft limit;
3. every region, and every pair of links that is near, at three poses ahead: y(q, v) after the reaction time, and
   where braking at all or at half of the acceleration cap would end. With dy/dt = v + D(v) a the rows read
   n J(y) (v + D a) <= k h(y): y approaches a surface only as fast as the room h left there allows.

Where nothing binds, the wanted torque is returned unchanged.
"""

from itertools import compress
from typing import NamedTuple, Protocol

import daqp
import numpy as np

from robotctl.hal.robot import Robot
from robotctl.hal.types import Vector
from robotctl.safety.box import JointBox
from robotctl.safety.proximity import NothingNear, ProximityLimit, Scene
from robotctl.safety.region import Row, regions
from robotctl.safety.shaper import Clip, ToolModel
from robotctl.safety.trip import Category, Protection, Trip

_REACTION_S = 0.02
"""Time in which a bound may be reached: it covers a late tick, the torque's rate, and a model that is wrong."""
_BRAKE_SHARES = (1.0, 0.5)
"""Shares of the acceleration cap at which stops are looked ahead to; joint limits rely on the smallest."""
_TRIP_REACTION_S = 0.01
"""Time before the braking that the motion measured has to be stoppable by."""
_BREACH = 2e-3
"""How far past a soft limit that stop may end, rad, and past the bound of a region, m."""
_UNBOUNDED = 1e30
_SOFT = 8
"""daqp's sense of a constraint that may give way."""
_SOLVED = (1, 2)
"""daqp's exit flags for an optimum, and for an optimum with a softened constraint."""


class ArmModel(ToolModel, Protocol):
    """What the shaper has to know of the arm. Arrays are (n,), of matrices (n, n)."""

    damping: Vector
    """Viscous friction, Nms/rad."""

    def tool_and_jacobian(self, position: Vector) -> tuple[Vector, Vector]: ...
    def mass_matrix(self, position: Vector) -> Vector: ...
    def bias(self, position: Vector, velocity: Vector) -> Vector: ...


class ShapedTorque(NamedTuple):
    """The shaper's answer."""

    torque: Vector
    """(n,), Nm"""
    clip: Clip


class TorqueShaper:
    """Shapes the torques of one robot. Remembers clearances only; every call stands for itself."""

    def __init__(self, robot: Robot, model: ArmModel, scene: Scene | None = None) -> None:
        """Shape for a robot's limits; with a `scene`, for its clearances, too."""
        safety, twin = robot.profile.safety, robot.profile.twin
        self._model = model
        self._dt = robot.period_ns * 1e-9
        self._reaction = _REACTION_S + twin.lag_s + twin.delay_s
        self._box = JointBox(robot, self._reaction, min(_BRAKE_SHARES), pull=0.25 / self._reaction)
        self._cap = robot.limits.torque
        self._step = robot.limits.torque_rate * self._dt
        self._regions = regions(robot.profile, safety.sphere_margin)
        # How long each joint brakes for per rad/s (n,), on the way to each pose that is looked ahead to.
        self._braking = [np.zeros(robot.dof)] + [1.0 / (share * self._box.acceleration_cap) for share in _BRAKE_SHARES]
        self._proximity = [ProximityLimit(robot, scene or NothingNear(robot.dof), 0) for _ in self._braking]

    def step(
        self, position: Vector, velocity: Vector, wanted: Vector, previous: Vector, external: Vector
    ) -> ShapedTorque:
        """Return the torque for the next servo period.

        Args:
            position: of the joints now (n,), rad.
            velocity: (n,), rad/s.
            wanted: torque to come as close to as the limits allow (n,), Nm, finite.
            previous: torque that was sent last (n,), Nm.
            external: what acts beside the drives, as observed (n,), Nm.
        """
        n, model, box = len(position), self._model, self._box
        middle = position + 0.5 * self._dt * velocity
        # Viscous friction is taken at the period's end: a joint that it dominates settles within the period.
        inertia = model.mass_matrix(middle) + self._dt * np.diag(model.damping)
        load = model.bias(middle, velocity) + model.damping * velocity - external
        mobility = np.linalg.inv(inertia)
        ahead, bounds, flags = self._ahead(position, velocity)
        slowest, fastest = box.bounds(position, velocity)
        rows = np.vstack([mobility, ahead @ mobility])
        free = rows @ load
        lower = np.concatenate([(slowest - velocity) / self._reaction, np.full(len(bounds), -_UNBOUNDED)]) + free
        upper = np.concatenate([(fastest - velocity) / self._reaction, bounds]) + free
        lower = np.concatenate([np.maximum(-self._cap, previous - self._step), lower])
        upper = np.concatenate([np.minimum(self._cap, previous + self._step), upper])
        result = np.concatenate([wanted, rows @ wanted])
        broken = (result > upper) | (result < lower)
        if not broken.any():
            return ShapedTorque(wanted, Clip.NONE)
        torque = self._solve(wanted, mobility, rows, lower, upper)
        if torque is None:
            torque = load + inertia @ (np.minimum(np.maximum(-velocity, -box.step), box.step) / self._reaction)
        clip = self._passed(velocity, velocity + self._reaction * (result[n:] - free)[:n], slowest, fastest)
        if broken[:n].any():
            clip |= Clip.TORQUE
        for flag in compress(flags, broken[2 * n :]):
            clip |= flag
        return ShapedTorque(np.minimum(np.maximum(torque, lower[:n]), upper[:n]), clip)

    def _ahead(self, position: Vector, velocity: Vector) -> tuple[Vector, Vector, list[Clip]]:
        """Return rows (m, n) and bounds (m,) on the acceleration, row . a <= bound, and the limit behind each."""
        rows, flags = [], []
        for braking, proximity in zip(self._braking, self._proximity, strict=True):
            rest = braking * np.abs(velocity)
            pose = position + (self._reaction + 0.5 * rest) * velocity
            point, jacobian = self._model.tool_and_jacobian(pose)
            found = [(region.row(point, jacobian), Clip.KEEP_OUT) for region in self._regions]
            found[0] = (found[0][0], Clip.SPHERE)
            found += [(row, Clip.PROXIMITY) for row in proximity.look(pose)[0]]
            for row, flag in found:
                if row is not None:
                    rows.append(Row(row.normal * (self._reaction + rest), row.bound - float(row.normal @ velocity)))
                    flags.append(flag)
        return np.array([row.normal for row in rows]), np.array([row.bound for row in rows]), flags

    def _passed(self, velocity: Vector, following: Vector, slowest: Vector, fastest: Vector) -> Clip:
        """Return which limits of joints a step from `velocity` to `following` passes, given the bounds of that step."""
        cap, step = self._box.velocity_cap, self._box.step
        most = np.minimum(cap, velocity + step)
        least = np.maximum(-cap, velocity - step)
        clip = Clip.NONE
        if (np.abs(following) > cap).any():
            clip |= Clip.VELOCITY
        if (np.abs(following - velocity) > step).any():
            clip |= Clip.ACCELERATION
        if (((following > fastest) & (fastest < most)) | ((following < slowest) & (slowest > least))).any():
            clip |= Clip.POSITION
        return clip

    def _solve(self, wanted: Vector, mobility: Vector, rows: Vector, lower: Vector, upper: Vector) -> Vector | None:
        n = len(wanted)
        sense = np.full(len(upper), _SOFT, dtype=np.int32)
        sense[:n] = 0
        levels = np.array([n, 2 * n, len(upper)], dtype=np.int32)
        solution, _, flag, _ = daqp.solve(mobility, -mobility @ wanted, rows, upper, lower, sense, levels)
        return np.asarray(solution) if flag in _SOLVED else None


class StoppableMotion:
    """Braking from the present motion has to end inside joint limits, velocity caps and regions; else category 2."""

    def __init__(self, robot: Robot, model: ToolModel) -> None:
        self._names = [joint.name for joint in robot.profile.joints]
        self._limits = robot.limits
        self._tolerance = robot.profile.safety.velocity_tolerance
        self._deceleration = (1.0 - robot.profile.safety.cap_margin) * robot.limits.acceleration
        self._regions = regions(robot.profile)
        self._tool = model.tool

    def check(self, position: Vector, velocity: Vector, stamp_ns: int) -> Trip | None:
        """Judge joint positions (n,), rad, and velocities (n,), rad/s."""
        speed = np.abs(velocity)
        ahead = _TRIP_REACTION_S * velocity + 0.5 * speed * velocity / self._deceleration
        stop = position + ahead
        beyond = np.maximum(stop - self._limits.upper, self._limits.lower - stop)
        fast = speed - self._limits.velocity - self._tolerance
        joint = int(beyond.argmax())
        if not beyond[joint] <= _BREACH:  # in this direction, so that NaN trips, too
            return _trip(f"{self._names[joint]} would stop {beyond[joint]:.3f} rad outside its limits", stamp_ns)
        joint = int(fast.argmax())
        if not fast[joint] <= 0.0:
            return _trip(f"{self._names[joint]} moves at {speed[joint]:.2f} rad/s, over its cap", stamp_ns)
        point = self._tool(stop)
        for region in self._regions:
            if region.room(point) < -_BREACH:
                return _trip(f"the tool would stop past the bound of {region.name!r}", stamp_ns)
        return None


def _trip(what: str, stamp_ns: int) -> Trip:
    cause = f"{what}; braking took over from the torque target"
    return Trip(Protection.TORQUE_STATE, Category.BRAKE_HOLD, cause, stamp_ns)
