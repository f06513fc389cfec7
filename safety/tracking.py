"""Protections that judge how the arm moves: P17 against its reference, P18 against its caps."""

import numpy as np

from robotctl.hal.robot import Robot
from robotctl.hal.types import Sample, Vector
from robotctl.safety.trip import Category, Protection, Trip

_OVERSPEED_SAMPLES = 3
_TOOL_WINDOW_NS = 50_000_000
"""Time over which the tool's speed is measured: over one servo period, rounding alone would be 0.1 m/s."""
_TOOL_TOLERANCE = 1.2


class TrackingError:
    """P17: the arm does not follow: a stuck joint, a collision, a wrong sign or gain, an unknown load."""

    def __init__(self, robot: Robot) -> None:
        safety = robot.profile.safety
        self._names = [joint.name for joint in robot.profile.joints]
        self._farthest = safety.tracking_error
        self._slip = safety.tracking_speed_share * robot.limits.velocity + safety.tracking_speed
        self._patience_ns = round(safety.tracking_time_s * 1e9)
        self._since_ns: int | None = None

    def check(self, sample: Sample, position: Vector, velocity: Vector) -> Trip | None:
        """Judge a sample against the reference's position (n,), rad, and velocity (n,), rad/s."""
        error = np.abs(position - sample.position)
        joint = int(error.argmax())
        if error[joint] > self._farthest:
            return self._trip(f"{self._names[joint]} is {error[joint]:.3f} rad away from where it was led", sample)
        slip = np.abs(velocity - sample.velocity) - self._slip
        joint = int(slip.argmax())
        if slip[joint] <= 0.0:
            self._since_ns = None
            return None
        if self._since_ns is None:
            self._since_ns = sample.stamp_ns
        if sample.stamp_ns - self._since_ns < self._patience_ns:
            return None
        what = f"{self._names[joint]} moves at {sample.velocity[joint]:.2f} rad/s, led at {velocity[joint]:.2f}"
        return self._trip(what, sample)

    def _trip(self, what: str, sample: Sample) -> Trip:
        cause = f"{what}; look for a collision, a stuck joint or an unknown load, then acknowledge"
        return Trip(Protection.TRACKING, Category.BRAKE_OFF, cause, sample.stamp_ns)


class Drift:
    """P17 at a standstill: an arm that should hold creeps away, so its torque cannot be trusted any more."""

    def __init__(self, robot: Robot) -> None:
        self._names = [joint.name for joint in robot.profile.joints]
        self._farthest = robot.profile.safety.standstill_drift
        self._held: Vector | None = None

    def check(self, sample: Sample, *, holding: bool) -> Trip | None:
        if not holding:
            self._held = None
            return None
        if self._held is None:
            self._held = sample.position
        drift = np.abs(sample.position - self._held)
        joint = int(drift.argmax())
        if drift[joint] <= self._farthest:
            return None
        cause = f"{self._names[joint]} crept by {drift[joint]:.3f} rad while the arm should hold; look for a load on it"
        return Trip(Protection.TRACKING, Category.CUT, cause, sample.stamp_ns)


class Overspeed:
    """P18: a measured joint is faster than its cap allows, whatever it was told."""

    def __init__(self, robot: Robot) -> None:
        safety = robot.profile.safety
        self._names = [joint.name for joint in robot.profile.joints]
        self._cap = robot.limits.velocity
        self._brake = safety.overspeed
        self._cut = safety.overspeed_cut
        self._samples = 0

    def check(self, sample: Sample) -> Trip | None:
        share = np.abs(sample.velocity) / self._cap
        joint = int(share.argmax())
        self._samples = self._samples + 1 if share[joint] > self._brake else 0
        if self._samples < _OVERSPEED_SAMPLES:
            return None
        category = Category.CUT if share[joint] > self._cut else Category.BRAKE_OFF
        cause = f"{self._names[joint]} moves at {sample.velocity[joint]:.2f} rad/s, its cap is {self._cap[joint]:g}"
        return Trip(Protection.OVERSPEED, category, cause, sample.stamp_ns)


class ToolSpeed:
    """P18 during reset routines: people are near, so the tool itself may be no faster than 250 mm/s."""

    def __init__(self, robot: Robot) -> None:
        self._cap = _TOOL_TOLERANCE * robot.profile.safety.reset_tool_speed
        self._from: tuple[int, Vector] | None = None

    def check(self, tool: Vector, stamp_ns: int, *, slow: bool) -> Trip | None:
        """Judge the measured tool point (3,), m; `slow` says whether the cap is in force."""
        if not slow:
            self._from = None
            return None
        if self._from is None:
            self._from = (stamp_ns, tool)
            return None
        begun_ns, begun = self._from
        if stamp_ns - begun_ns < _TOOL_WINDOW_NS:
            return None
        self._from = (stamp_ns, tool)
        speed = float(np.linalg.norm(tool - begun)) / (stamp_ns - begun_ns) * 1e9
        if speed <= self._cap:
            return None
        cause = f"the tool moves at {speed:.2f} m/s during a reset routine"
        return Trip(Protection.OVERSPEED, Category.BRAKE_OFF, cause, stamp_ns)
