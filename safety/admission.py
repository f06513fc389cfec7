"""P9 and P10: which of a policy's targets are let in. Finite, right shape, right epoch, newer, not expired."""

from collections import deque

import numpy as np

from robotctl.hal.robot import Robot
from robotctl.safety.target import FreeDrive, Hold, JointTorque, JointVelocity, Target
from robotctl.safety.trip import Category, Protection, Trip

_MALFORMED_TO_FAULT = 3


class Admission:
    """Remembers the latest admitted target, and judges every new one once."""

    def __init__(self, robot: Robot) -> None:
        safety = robot.profile.safety
        self._dof = robot.dof
        self._heartbeat_ns = round(safety.heartbeat_s * 1e9)
        self._window_ns = round(safety.malformed_window_s * 1e9)
        self._malformed: deque[int] = deque(maxlen=_MALFORMED_TO_FAULT)
        self.seq = -1
        """Sequence number of the last target let in."""
        self._target: Target | None = None
        self._expires_ns = 0
        self.refused = 0
        """Targets dropped for an old epoch, an old sequence number or a deadline that had passed."""

    def begin(self, now_ns: int) -> None:
        """Begin with any sequence number: the policy may be a new one. For the operator's START."""
        self.seq = -1
        self.renew(now_ns)

    def renew(self, now_ns: int) -> None:
        """Forget the target; the policy has one heartbeat from now to send the next. For entries into RUN."""
        self._target = None
        self._expires_ns = now_ns + self._heartbeat_ns

    def offer(self, target: Target, epoch: int, now_ns: int) -> Trip | None:
        """Take a new target in, drop it, or trip on it. Never raises, whatever the target holds.

        Args:
            epoch: the supervisor's present epoch.
        """
        complaint = self._complaint(target)
        if complaint:
            return self._malformed_trip(complaint, now_ns)
        if target.epoch != epoch or target.seq <= self.seq or target.deadline_ns <= now_ns:
            self.refused += 1
            return None
        self.seq = target.seq
        self._target = target
        self._expires_ns = min(target.deadline_ns, now_ns + self._heartbeat_ns)
        return None

    def fresh(self, now_ns: int) -> Target | None:
        """Return the admitted target while it is valid, else None."""
        return self._target if now_ns < self._expires_ns else None

    def heartbeat(self, now_ns: int) -> Trip | None:
        """Trip (category 2) if nothing valid came in time."""
        if now_ns < self._expires_ns:
            return None
        cause = f"no fresh target from the policy for {(now_ns - self._expires_ns + self._heartbeat_ns) / 1e6:.0f} ms"
        return Trip(Protection.HEARTBEAT, Category.BRAKE_HOLD, cause, self._expires_ns)

    def _complaint(self, target: Target) -> str:
        match target:
            case JointVelocity(values=values) | JointTorque(values=values):
                if not isinstance(values, np.ndarray) or values.dtype != np.float64:
                    return f"values are not a float64 array but {type(values).__name__}"
                if values.shape != (self._dof,):
                    return f"shape {values.shape} instead of ({self._dof},)"
                if not np.isfinite(values).all():
                    return f"value {int(np.flatnonzero(~np.isfinite(values))[0])} is not finite"
                return ""
            case Hold() | FreeDrive():
                return ""
            case _:
                return f"not a target but {type(target).__name__}"

    def _malformed_trip(self, complaint: str, now_ns: int) -> Trip:
        self._malformed.append(now_ns)
        repeated = len(self._malformed) == _MALFORMED_TO_FAULT and now_ns - self._malformed[0] <= self._window_ns
        category = Category.BRAKE_OFF if repeated else Category.BRAKE_HOLD
        count = f", {_MALFORMED_TO_FAULT} times within {self._window_ns / 1e9:g} s" if repeated else ""
        return Trip(Protection.MALFORMED, category, f"policy sent a malformed target: {complaint}{count}", now_ns)
