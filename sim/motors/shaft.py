"""The shaft of one motor: an axis of the plant, seen in the motor's own coordinates (rad, rad/s, Nm)."""

from robotctl.sim.plant import Plant

SERVO_RATE = 40.0
"""Natural frequency of a drive's own position loop, rad/s. Set by us: the vendor publishes none."""


class Shaft:
    """motor angle = scale * (axis position - origin); motor torque = axis torque / scale.

    `scale` holds sign and gear of a joint, or, for a gripper, motor radians per unit of finger travel.
    """

    __slots__ = ("_axis", "_kd", "_kp", "_origin", "_part", "_plant", "_runaway", "_scale", "_square", "servo_gains")

    def __init__(self, plant: Plant, axis: int, scale: float, origin: float, kp: float, kd: float) -> None:
        """Take an axis whose drive is off; `kp` and `kd` are the least of its own loop, in axis coordinates."""
        self._plant = plant
        self._axis = axis
        self._scale = scale
        self._square = scale * scale
        self._origin = origin
        self._kp = 0.0
        self._kd = 0.0
        self._part = 1.0
        self._runaway: float | None = None
        inertia = plant.inertia(axis)
        self.servo_gains = (
            max(kp, SERVO_RATE**2 * inertia) / self._square,
            max(kd, 2.0 * SERVO_RATE * inertia) / self._square,
        )
        """Nm/rad and Nms/rad of the drive's own position loop, critically damped for the bare axis."""

    def state(self) -> tuple[float, float, float]:
        """Return true angle, speed and torque."""
        position, velocity, effort = self._plant.axis(self._axis)
        scale = self._scale
        return scale * (position - self._origin), scale * velocity, effort / scale

    def drive(self, kp: float, kd: float, position: float, velocity: float, effort: float) -> None:
        """Set the law torque = kp (position - q) + kd (velocity - dq) + effort."""
        if self._runaway is not None:
            return
        scale, part = self._scale, self._part
        if part < 0.0:  # MuJoCo's implicit step takes no negative damping
            angle, speed, _ = self.state()
            effort += kp * (position - angle) + kd * (velocity - speed)
            kp = kd = 0.0
        square = part * self._square
        self._plant.drive(
            self._axis,
            kp * square,
            kd * square,
            position / scale + self._origin,
            velocity / scale,
            part * effort * scale,
        )
        if kp != self._kp or kd != self._kd:
            # The lag filters kp p + kd v + t as one number; with other gains its old state means nothing.
            self._kp, self._kd = kp, kd
            self._plant.settle_lag(self._axis)

    def release(self) -> None:
        """Switch off: no torque; the brake, where there is one, closes."""
        self._kp = self._kd = 0.0
        self._plant.release(self._axis)

    def limit(self, effort: float | None) -> None:
        """Bound the torque, Nm; None takes the bound away."""
        self._plant.limit(self._axis, None if effort is None else effort * abs(self._scale))

    def jam(self, jammed: bool) -> None:
        """Seize up, or run freely again."""
        self._plant.jam(self._axis, jammed)

    @property
    def is_running_away(self) -> bool:
        """Whether it turns with a torque of its own."""
        return self._runaway is not None

    def weaken(self, part: float) -> None:
        """Apply this part of every torque from the next command on; 1 is all of it."""
        self._part = part

    def run_away(self, effort: float | None) -> None:
        """Turn with this torque, Nm, whatever the drive says, until called with None."""
        self._runaway = None
        if effort is None:
            self.release()
        else:
            self.drive(0.0, 0.0, 0.0, 0.0, effort)
            self._runaway = effort
