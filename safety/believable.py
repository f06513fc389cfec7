"""P15: measurements that cannot be true are not used; if they keep coming, the arm is stopped."""

from collections import deque

import numpy as np

from robotctl.hal.robot import Robot
from robotctl.hal.types import Sample
from robotctl.safety.trip import Category, Protection, Trip

_FASTEST = 3.0
"""Multiple of its velocity cap at which a joint may have moved between two measurements."""
_NOISE = 0.01
"""rad"""
_WINDOW_NS = 1_000_000_000


class Believable:
    """Screens samples. What is unbelievable keeps its old value and its old stamp, and so grows stale (P12)."""

    def __init__(self, robot: Robot) -> None:
        self._names = [joint.name for joint in robot.profile.joints]
        self._fastest = _FASTEST * robot.limits.velocity * 1e-9
        self._most = robot.profile.safety.rejected_frames
        self._kept: Sample | None = None
        self._rejected: int | None = None
        self._refused: deque[int] = deque(maxlen=self._most)
        self._cause: str
        """Of the latest refusal."""

    def screen(self, sample: Sample) -> Sample:
        """Return the sample with what can be believed of it."""
        if self._rejected is not None and sample.rejected > self._rejected:
            self._refuse("frames of wrong length or without sense", sample.stamp_ns, sample.rejected - self._rejected)
        self._rejected = sample.rejected
        kept = self._kept
        if kept is None:
            if np.isfinite(sample.position).all():
                self._kept = sample
            return sample
        way = np.abs(sample.position - kept.position)
        reach = self._fastest * (sample.joint_stamp_ns - kept.joint_stamp_ns) + _NOISE
        # Written so that what is no number is not believed.
        sound = (way <= reach) & np.isfinite(sample.velocity)
        if not sound.all():
            joint = int(sound.argmin())
            self._refuse(
                f"{self._names[joint]} at {sample.position[joint]:.3f} rad after {kept.position[joint]:.3f}",
                sample.stamp_ns,
            )
            sample = sample._replace(
                position=np.where(sound, sample.position, kept.position),
                velocity=np.where(sound, sample.velocity, kept.velocity),
                effort=np.where(sound, sample.effort, kept.effort),
                joint_stamp_ns=np.where(sound, sample.joint_stamp_ns, kept.joint_stamp_ns),
            )
        self._kept = sample
        return sample

    def check(self, now_ns: int) -> Trip | None:
        """Trip (category 1) when too much within a second could not be believed."""
        refused = self._refused
        if len(refused) < self._most or now_ns - refused[0] > _WINDOW_NS:
            return None
        cause = (
            f"{self._most} measurements within {_WINDOW_NS / 1e9:g} s cannot be true, the last: {self._cause}; "
            "look for another sender on the bus, a broken adapter or encoder, then acknowledge"
        )
        return Trip(Protection.RECEIVE, Category.BRAKE_OFF, cause, refused[-1])

    def forget(self) -> None:
        """Believe the next sample: the arm is off, and may have been moved, or woken up a turn away."""
        self._kept = None
        self._refused.clear()

    def _refuse(self, cause: str, stamp_ns: int, count: int = 1) -> None:
        self._cause = cause
        self._refused.extend([stamp_ns] * min(count, self._most))
