"""P8: in torque mode nothing leads the arm along a reference, so the measured motion itself must be stoppable."""

import numpy as np

from robotctl.hal.robot import Robot
from robotctl.hal.types import Sample
from robotctl.safety.region import regions
from robotctl.safety.shaper import ToolModel
from robotctl.safety.trip import Category, Protection, Trip

_BRAKE_SHARE = 0.5
"""Part of the acceleration cap that a prediction relies on; the rest is for what the model does not know."""
_REACTION_S = 0.01


class StoppableMotion:
    """Braking from the measured state has to end inside joint limits, velocity caps and regions; else category 2."""

    def __init__(self, robot: Robot, model: ToolModel) -> None:
        self._names = [joint.name for joint in robot.profile.joints]
        self._limits = robot.limits
        self._deceleration = _BRAKE_SHARE * robot.limits.acceleration
        self._regions = regions(robot.profile, robot.profile.safety.sphere_margin)
        self._tool = model.tool

    def check(self, sample: Sample) -> Trip | None:
        speed = np.abs(sample.velocity)
        ahead = _REACTION_S * sample.velocity + 0.5 * speed * sample.velocity / self._deceleration
        stop = sample.position + ahead
        beyond = np.maximum(stop - self._limits.upper, self._limits.lower - stop)
        fast = speed - self._limits.velocity
        joint = int(beyond.argmax())
        if not beyond[joint] <= 0.0:  # in this direction, so that NaN trips, too
            return self._trip(f"{self._names[joint]} would stop {beyond[joint]:.3f} rad outside its limits", sample)
        joint = int(fast.argmax())
        if not fast[joint] <= 0.0:
            return self._trip(f"{self._names[joint]} moves at {speed[joint]:.2f} rad/s, over its cap", sample)
        path = np.array([self._tool(sample.position + share * ahead) for share in (0.0, 0.5, 1.0)])
        for region in self._regions:
            if region.along(path) < 0.0:
                return self._trip(f"the tool would stop past the bound of {region.name!r}", sample)
        return None

    def _trip(self, what: str, sample: Sample) -> Trip:
        cause = f"{what}; braking took over from the torque target"
        return Trip(Protection.TORQUE_STATE, Category.BRAKE_HOLD, cause, sample.stamp_ns)
