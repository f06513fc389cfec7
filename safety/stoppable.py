"""P8: nothing leads an arm that follows torques, so the motion that was measured has itself to be stoppable."""

import numpy as np

from robotctl.hal.robot import Robot
from robotctl.hal.types import Vector
from robotctl.safety.region import regions
from robotctl.safety.shaper import ToolModel
from robotctl.safety.trip import Category, Protection, Trip

_REACTION_S = 0.01
"""Time until the braking begins."""
_BREACH = 2e-3
"""How far past a soft limit a stop may end, rad, and past the bound of a region, m."""


class StoppableMotion:
    """Braking from the present motion has to end inside joint limits, velocity caps and regions; else category 2."""

    def __init__(self, robot: Robot, model: ToolModel) -> None:
        safety = robot.profile.safety
        self._names = [joint.name for joint in robot.profile.joints]
        self._limits = robot.limits
        self._fastest = robot.limits.velocity + safety.velocity_tolerance
        self._deceleration = (1.0 - safety.cap_margin) * robot.limits.acceleration
        self._regions = regions(robot.profile)
        self._tool = model.tool

    def check(self, position: Vector, velocity: Vector, stamp_ns: int) -> Trip | None:
        """Judge joint positions (n,), rad, and velocities (n,), rad/s."""
        speed = np.abs(velocity)
        stop = position + (_REACTION_S + 0.5 * speed / self._deceleration) * velocity
        beyond = np.maximum(stop - self._limits.upper, self._limits.lower - stop)
        joint = int(beyond.argmax())
        if not beyond[joint] <= _BREACH:  # in this direction, so that NaN trips, too
            return _trip(f"{self._names[joint]} would stop {beyond[joint]:.3f} rad outside its limits", stamp_ns)
        joint = int((speed - self._fastest).argmax())
        if not speed[joint] <= self._fastest[joint]:
            return _trip(f"{self._names[joint]} moves at {speed[joint]:.2f} rad/s, over its cap", stamp_ns)
        point = self._tool(stop)
        for region in self._regions:
            if region.room(point) < -_BREACH:
                return _trip(f"the tool would stop past the bound of {region.name!r}", stamp_ns)
        return None


def _trip(what: str, stamp_ns: int) -> Trip:
    cause = f"{what}; braking took over from the torque target"
    return Trip(Protection.TORQUE_STATE, Category.BRAKE_HOLD, cause, stamp_ns)
