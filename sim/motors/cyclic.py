"""The loops that a CiA 402 drive closes by itself: cyclic synchronous position, velocity and torque; quick stop."""

from robotctl.hal.can.cia402.codec import Mode
from robotctl.sim.motors.shaft import Shaft

COASTING = 1.0
"""Cycles for which a position reference goes on without a new target: as long as it takes to lose one frame."""


class Loops:
    """Drives a shaft in motor coordinates: rad, rad/s, Nm.

    Position and velocity loop have the gains that the drive was commissioned with. A position is interpolated: a
    target is reached one cycle after it was given, as object 0x60C2 says. Where the next one is late, the reference
    goes on at the velocity offset for `COASTING` cycles, and then stands. A velocity is integrated to a position that
    is held, as a loop with an integrator does.
    """

    def __init__(self, shaft: Shaft, kp: float, kd: float) -> None:
        """Take a shaft that is released; `kp` (Nm/rad) and `kd` (Nms/rad) are the motor's."""
        self._shaft = shaft
        self._kp, self._kd = kp, kd
        self.mode = Mode.NONE
        self.reference = 0.0
        """Where the position loop wants the motor, rad."""
        self._rate = 0.0
        self._age = self._cycle = 0.0
        self._velocity = 0.0
        self._torque = 0.0
        self._deceleration: float | None = None

    def start(self) -> None:
        """Hold the shaft where it is."""
        self.mode = Mode.POSITION
        self.reference = self._shaft.state()[0]
        self._rate = self._velocity = self._torque = 0.0
        self._deceleration = None
        self._apply()

    def follow(self, mode: Mode, target: float, velocity: float, torque: float, cycle_s: float) -> None:
        """Take a new setpoint: a position to reach within a cycle, a velocity, a torque."""
        if mode is not self.mode or mode is Mode.TORQUE:
            self.reference = self._shaft.state()[0]
        self.mode, self._velocity, self._torque = mode, velocity, torque
        self._rate = (target - self.reference) / cycle_s
        self._age, self._cycle = 0.0, cycle_s
        self._apply()

    def quick_stop(self, deceleration: float) -> None:
        """Slow down along a ramp, rad/s^2, and stand."""
        position, speed, _ = self._shaft.state()
        self.mode, self.reference, self._velocity = Mode.VELOCITY, position, speed
        self._deceleration = deceleration

    @property
    def stands(self) -> bool:
        """Whether a quick stop is over."""
        return self._deceleration is not None and self._velocity == 0.0

    @property
    def error(self) -> float:
        """How far the shaft is from where the position loop wants it, rad; 0 in torque mode."""
        return 0.0 if self.mode is Mode.TORQUE else self.reference - self._shaft.state()[0]

    def step(self, seconds: float) -> None:
        """Let time pass."""
        if self._deceleration is not None:
            slower = self._deceleration * seconds
            self._velocity -= min(max(self._velocity, -slower), slower)
        if self.mode is Mode.POSITION:
            self._age += seconds
            if self._age < self._cycle + 1e-9:
                self.reference += self._rate * seconds
            elif self._age < (1.0 + COASTING) * self._cycle + 1e-9:
                self.reference += self._velocity * seconds
        elif self.mode is Mode.VELOCITY:
            self.reference += self._velocity * seconds
        self._apply()

    def _apply(self) -> None:
        if self.mode is Mode.TORQUE:
            self._shaft.drive(0.0, 0.0, 0.0, 0.0, self._torque)
        else:
            self._shaft.drive(self._kp, self._kd, self.reference, self._velocity, self._torque)
