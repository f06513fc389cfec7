"""Protections that judge the drives and what connects them: P14 the bus, P24 the drives themselves."""

from robotctl.hal.robot import Robot
from robotctl.hal.types import Sample
from robotctl.safety.trip import Category, Protection, Trip

BUS = "bus"
"""What a fault of the bus names as its joint."""
_UNDELIVERED = 5
_WARN_BELOW = 10.0
"""K"""


class BusHealth:
    """P14: the controller reports trouble, or commands do not leave the host."""

    def __init__(self) -> None:
        self._undelivered = 0

    def sent(self, *, delivered: bool) -> None:
        """Take note of whether a command left the host."""
        self._undelivered = 0 if delivered else self._undelivered + 1

    def forget(self) -> None:
        """Begin anew: the drives are off."""
        self._undelivered = 0

    def check(self, sample: Sample) -> Trip | None:
        for fault in sample.faults:
            if fault.joint == BUS:
                return self._trip(f"the bus reports {fault.name}; {fault.hint}", sample)
        if self._undelivered >= _UNDELIVERED:
            return self._trip(f"{_UNDELIVERED} commands in a row did not leave the host; check power and cable", sample)
        return None

    def _trip(self, cause: str, sample: Sample) -> Trip:
        return Trip(Protection.BUS, Category.BRAKE_OFF, f"{cause}, then acknowledge", sample.stamp_ns)


class DriveHealth:
    """P24: a drive reports a fault, is too hot, or lost its torque while the arm should hold."""

    def __init__(self, robot: Robot) -> None:
        self._names = [joint.name for joint in robot.profile.joints]
        self._hot = robot.profile.safety.temperature

    def check(self, sample: Sample) -> Trip | None:
        for fault in sample.faults:
            if fault.joint != BUS:
                return self._trip(
                    f"{fault.joint}: drive reports {fault.name} (code 0x{fault.code:X}); {fault.hint}", sample
                )
        if not sample.enabled:
            return self._trip("a drive went off by itself; check its power and watchdog", sample)
        hot = self._hottest(sample, self._hot)
        return self._trip(f"{hot}, too hot; let it cool", sample) if hot else None

    def warning(self, sample: Sample) -> str:
        """Return which drive is about to be too hot, or nothing."""
        return self._hottest(sample, self._hot - _WARN_BELOW)

    def _hottest(self, sample: Sample, above: float) -> str:
        if sample.temperature is None:
            return ""
        joint = int(sample.temperature.argmax())
        degrees = sample.temperature[joint]
        return f"{self._names[joint]} is at {degrees:.0f} degrees C" if degrees > above else ""

    def _trip(self, cause: str, sample: Sample) -> Trip:
        return Trip(Protection.DRIVE, Category.BRAKE_OFF, cause, sample.stamp_ns)
