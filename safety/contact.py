"""P19, the contact reflex: torques that neither drives nor model account for mean that the arm touches something."""

import numpy as np

from robotctl.hal.robot import Robot
from robotctl.hal.types import Vector
from robotctl.safety.trip import Category, Protection, Trip


class ContactReflex:
    """Judges what the momentum observer finds."""

    def __init__(self, robot: Robot) -> None:
        safety = robot.profile.safety
        self._names = [joint.name for joint in robot.profile.joints]
        # By P17 a joint of soft gains would be stopped before its drive has much to push with.
        gains = np.array([joint.gains.kp for joint in robot.profile.joints])
        self.threshold = safety.contact * np.minimum(gains * safety.tracking_error, robot.limits.torque)
        """Torques that count as contact (n,), Nm."""
        self._patience_ns = round(safety.contact_time_s * 1e9)
        self._since_ns: int | None = None
        self.touched = False
        """Whether a torque is above its threshold now."""

    def check(self, external: Vector, stamp_ns: int) -> Trip | None:
        """Trip (category 2) when the external torque (n,), Nm, of a joint stays above its threshold."""
        excess = np.abs(external) - self.threshold
        joint = int(excess.argmax())
        self.touched = bool(excess[joint] > 0.0)
        if not self.touched:
            self._since_ns = None
            return None
        if self._since_ns is None:
            self._since_ns = stamp_ns
        if stamp_ns - self._since_ns < self._patience_ns:
            return None
        cause = (
            f"{self._names[joint]} feels {external[joint]:.1f} Nm from outside, {self.threshold[joint]:.1f} are "
            "allowed; it yields until it is let go; clear its way, then acknowledge"
        )
        return Trip(Protection.CONTACT, Category.BRAKE_HOLD, cause, stamp_ns)
