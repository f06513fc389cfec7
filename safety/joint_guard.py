"""What the guard allows one joint: every limit of its profile, against the last message that was let through."""

import math

from robotctl.hal.profile import Joint, Safety
from robotctl.safety.asked import Asked, Kind, Refusal, Step
from robotctl.safety.trip import Protection

_ROUNDING = 1.001
"""Room for floating point: a limit passed by less is no finding."""
_NUMERIC = 1e-6
"""The same for the place of a stop, rad."""
_LEAST_DAMPING = 0.5
"""Nms/rad of the motor with which a drive may damp, whatever its tracking gain: it may have to stop a falling arm."""


class JointGuard:
    """Judges what one joint is asked. `keep` tells it what was let through."""

    def __init__(self, joint: Joint, safety: Safety) -> None:
        self._name = joint.name
        self._middle = 0.5 * (joint.position[0] + joint.position[1])
        self._half = 0.5 * (joint.position[1] - joint.position[0])
        self._velocity = _ROUNDING * joint.velocity
        self._acceleration = _ROUNDING * joint.acceleration
        self._braking = (1.0 - safety.cap_margin) * joint.acceleration
        self._effort = _ROUNDING * joint.torque
        self._effort_rate = _ROUNDING * joint.torque_rate
        self._effort_step = safety.track_step * joint.torque
        self._kp = _ROUNDING * joint.gains.kp
        gear = joint.drive.gear if joint.drive else 0.0
        self._kd = _ROUNDING * max(joint.gains.kd, _LEAST_DAMPING * gear**2)
        self._standstill = safety.standstill
        self._bump = safety.bump
        self._tolerance = safety.velocity_tolerance
        self._last: Asked | None = None
        self._excess = math.inf
        """Least that braking ended past a soft limit since the joint is led, rad; negative inside."""

    def forget(self) -> None:
        """Start anew: the drive is off."""
        self._last = None
        self._excess = math.inf

    def keep(self, asked: Asked) -> None:
        """Compare the next message with this one, which was let through."""
        self._last = asked
        excess = self._stop_excess(asked.position, asked.velocity)
        self._excess = min(self._excess, excess) if asked.kind is Kind.TRACK else math.inf

    def refuse(
        self, asked: Asked, step: Step, position: float, velocity: float, seconds: float, *, standing: bool
    ) -> Refusal | None:
        """Return why a message may not leave, or None.

        Args:
            asked: what it asks.
            step: what rounding may have cost it.
            position: measured, rad.
            velocity: measured, rad/s.
            seconds: wall time there was for the change since the last message.
            standing: whether the arm is to stand still.
        """
        kind, target, speed, kp, kd, effort = asked
        if not all(map(math.isfinite, (target, speed, kp, kd, effort))):
            return self._refusal(Protection.FRAMES, "a value that is no number")
        if kp > self._kp + step.kp or kd > self._kd + step.kd:
            return self._refusal(Protection.FRAMES, f"gains {kp:.1f} and {kd:.2f}, above the profile's")
        if abs(effort) > self._effort + step.effort:
            return self._refusal(Protection.TORQUE, f"{effort:.2f} Nm, above its torque cap")
        if kind is Kind.DAMP:
            # The last resort of an arm without brakes: its torque comes at once.
            return self._refusal(Protection.FRAMES, "damping towards a motion") if abs(speed) > step.velocity else None
        last = self._last
        # A tracking drive makes its torque itself; what comes on top jumps when full braking sets in.
        once = 2.0 * step.effort + (self._effort_step if kind is Kind.TRACK else 0.0)
        if last is not None and abs(effort - last.effort) > self._effort_rate * seconds + once:
            return self._refusal(Protection.TORQUE, f"{effort - last.effort:+.2f} Nm at once, above its rate cap")
        if kind is Kind.TORQUE:
            return None
        if standing and abs(speed) > self._standstill + step.velocity:
            return self._refusal(Protection.FRAMES, f"{speed:.3f} rad/s, while the arm is to stand still")
        if abs(speed) > self._velocity + step.velocity:
            return self._refusal(Protection.VELOCITY, f"{speed:.3f} rad/s, above its velocity cap")
        if last is None or last.kind is not Kind.TRACK:
            return self._refuse_start(asked, step, position, velocity, seconds)
        if abs(target - last.position) > self._velocity * seconds + 2.0 * step.position:
            return self._refusal(Protection.VELOCITY, f"{target - last.position:+.4f} rad at once")
        if abs(speed - last.velocity) > self._acceleration * seconds + 2.0 * step.velocity:
            return self._refusal(Protection.ACCELERATION, f"{speed - last.velocity:+.3f} rad/s at once")
        return self._refuse_stop(asked, step, self._excess)

    def _refuse_start(
        self, asked: Asked, step: Step, position: float, velocity: float, seconds: float
    ) -> Refusal | None:
        """Judge the first message that leads a joint: it has to begin where the joint is, as it moves.

        The comparisons let no measurement pass that is no number.
        """
        if not abs(asked.position - position) <= self._bump + self._velocity * seconds + step.position:
            text = f"start at {asked.position:.3f} rad, measured at {position:.3f}"
            return self._refusal(Protection.BUMP, text)
        # A measured speed beyond the cap is led on at the cap.
        jump = abs(asked.velocity - max(-self._velocity, min(velocity, self._velocity)))
        if not jump <= self._acceleration * seconds + self._tolerance + step.velocity:
            return self._refusal(Protection.BUMP, f"start at {asked.velocity:.3f} rad/s, measured {velocity:.3f}")
        return self._refuse_stop(asked, step, self._stop_excess(position, velocity))

    def _refuse_stop(self, asked: Asked, step: Step, before: float) -> Refusal | None:
        """Refuse a motion whose braking ends past a soft limit, and further out than from where it comes."""
        excess = self._stop_excess(asked.position, asked.velocity)
        if excess <= 0.0:
            return None
        rounding = step.position + step.velocity * (abs(asked.velocity) + step.velocity) / self._braking
        if excess > max(before, 0.0) + 2.0 * rounding + _NUMERIC:
            return self._refusal(Protection.SOFT_LIMIT, f"{asked.position:.3f} rad at {asked.velocity:.3f} rad/s")
        return None

    def _stop_excess(self, position: float, velocity: float) -> float:
        """Return how far past a soft limit braking would end, rad; negative inside."""
        stop = position + 0.5 * velocity * abs(velocity) / self._braking
        return abs(stop - self._middle) - self._half

    def _refusal(self, protection: Protection, text: str) -> Refusal:
        return Refusal(protection, f"{self._name} was asked for {text}")
