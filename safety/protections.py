"""Protections that judge where the arm was measured, and how long ago: P3, P5 and P12.

The supervisor asks each in every tick; it answers with a `Trip` or None. How the arm moves is judged in `tracking.py`,
its drives in `drives.py`, whether a measurement can be true in `believable.py`. Those that shape commands live in
`shaper.py`, those that judge targets in `admission.py`, and what leaves for the drives is judged by `guard.py`.
"""

import numpy as np

from robotctl.hal.robot import Robot
from robotctl.hal.types import Sample, Vector
from robotctl.safety.region import regions
from robotctl.safety.trip import Category, Protection, Trip


class PositionBreach:
    """P3: a measured joint is past its soft limit by more than the profile's `position_breach`."""

    def __init__(self, robot: Robot) -> None:
        breach = robot.profile.safety.position_breach
        self._names = [joint.name for joint in robot.profile.joints]
        self._limits = robot.limits
        self._middle = 0.5 * (robot.limits.upper + robot.limits.lower)
        self._half = 0.5 * (robot.limits.upper - robot.limits.lower) + breach

    def inside(self, position: Vector) -> bool:
        """Return whether all joints (n,) are within their soft limits."""
        return bool(((position >= self._limits.lower) & (position <= self._limits.upper)).all())

    def check(self, sample: Sample) -> Trip | None:
        beyond = np.abs(sample.position - self._middle) - self._half
        joint = int(beyond.argmax())
        if beyond[joint] <= 0.0:  # in this direction, so that NaN trips, too
            return None
        where = f"{self._names[joint]} measured at {sample.position[joint]:.3f} rad, outside its limits"
        return Trip(Protection.POSITION, Category.BRAKE_OFF, f"{where}; acknowledge, then retreat", sample.stamp_ns)


class SphereBreach:
    """P5: the measured tool point is past the bound of a region by more than the profile's `sphere_breach`."""

    def __init__(self, robot: Robot) -> None:
        self._regions = regions(robot.profile)
        self._breach = robot.profile.safety.sphere_breach

    def outside(self, tool: Vector) -> float:
        """Return how far `tool` (3,) is outside the region it is furthest outside of, m; negative inside all."""
        return self._worst(tool)[0]

    def check(self, tool: Vector, stamp_ns: int) -> Trip | None:
        outside, name = self._worst(tool)
        if outside <= self._breach:
            return None
        cause = f"tool measured {1e3 * outside:.0f} mm past the bound of {name!r}; acknowledge, then retreat"
        return Trip(Protection.SPHERE, Category.BRAKE_HOLD, cause, stamp_ns)

    def _worst(self, tool: Vector) -> tuple[float, str]:
        return max((-region.room(tool), region.name) for region in self._regions)


class FeedbackAge:
    """P12: a joint was not heard of. Young enough: nothing; older: `stale`; too old: a trip."""

    def __init__(self, robot: Robot) -> None:
        self._names = [joint.name for joint in robot.profile.joints]
        self._stop_ns = round(robot.profile.safety.feedback_stop_s * 1e9)
        self._fault_ns = round(robot.profile.safety.feedback_fault_s * 1e9)
        self.stale = False
        """Whether the reference is to be braked to rest."""
        self.lost = False
        """Whether nothing is known of the arm any more."""
        self.dead = False
        """Whether not one joint is heard of: the drives have no power."""

    def check(self, sample: Sample, now_ns: int) -> Trip | None:
        stamps = sample.joint_stamp_ns
        if sample.cut_off:  # P14 stops the arm for them; of the others enough is known to brake and to lower them
            stamps = stamps.copy()
            stamps[list(sample.cut_off)] = now_ns
        age = now_ns - int(stamps.min())
        self.stale = age > self._stop_ns
        self.lost = age > self._fault_ns
        self.dead = now_ns - int(sample.joint_stamp_ns.max()) > self._fault_ns
        if not self.lost:
            return None
        joint = int(stamps.argmin())
        heard = int(stamps[joint])
        cause = (
            f"{self._names[joint]} has not answered for {age / 1e6:.0f} ms; "
            "check its power, its connector and the bus, then acknowledge"
        )
        return Trip(Protection.FEEDBACK, Category.BRAKE_OFF, cause, heard + self._fault_ns)
