"""The loops that a drive closes by itself in the modes POS_VEL, VEL and POS_FORCE."""

from robotctl.sim.motors.shaft import Shaft

INTEGRAL_RATE = 10.0
"""How fast the loops take up a steady load, 1/s."""


class Servo:
    """A setpoint that moves no faster than it is asked to, and a PID controller that follows it.

    Motor coordinates: rad, rad/s, Nm. There is no ramp: ACC and DEC (registers 4 and 5) are without effect.
    """

    __slots__ = ("_bound", "_integral", "_setpoint", "_shaft", "_speed", "_target")

    def __init__(self, shaft: Shaft) -> None:
        """Start where the shaft is."""
        self._shaft = shaft
        self._setpoint = shaft.state()[0]
        self._integral = 0.0
        self._target: float | None = None
        self._speed = 0.0
        self._bound = 0.0

    def aim(self, target: float | None, speed: float, bound: float) -> None:
        """Go to `target`, or on for ever if it is None, at `speed`, with a torque of at most `bound`."""
        self._target, self._speed = target, speed
        self._bound = max(bound, 1e-6)

    def step(self, seconds: float) -> None:
        """Run for one step."""
        step = self._speed * seconds
        if self._target is not None:
            step = min(max(self._target - self._setpoint, -step), step)
        angle = self._shaft.state()[0]
        kp, kd = self._shaft.servo_gains
        # A setpoint that ran away from a blocked shaft, or an integral beyond the torque there is, would wind up.
        lead = self._bound / kp
        self._setpoint = min(max(self._setpoint + step, angle - lead), angle + lead)
        error = self._setpoint - angle
        if abs(kp * error + self._integral) < self._bound or error * self._integral < 0.0:
            self._integral += INTEGRAL_RATE * kp * error * seconds
        self._shaft.drive(kp, kd, self._setpoint, step / seconds, self._integral)
