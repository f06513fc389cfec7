"""Turns what a target asks for into a smooth motion: ruckig for velocities, a rate cap for torques."""

import numpy as np
import ruckig

from robotctl.hal.robot import Robot
from robotctl.hal.types import Vector


class VelocityLimiter:
    """Jerk-limited approach to a wanted velocity, from whatever motion the reference is in."""

    def __init__(self, robot: Robot) -> None:
        n = robot.dof
        usable = 1.0 - robot.profile.safety.cap_margin
        self.cap = usable * robot.limits.velocity
        self._acceleration = usable * robot.limits.acceleration
        self._generator = ruckig.Ruckig(n, robot.period_ns * 1e-9)
        self._input = ruckig.InputParameter(n)
        self._output = ruckig.OutputParameter(n)
        self._input.control_interface = ruckig.ControlInterface.Velocity
        self._input.synchronization = ruckig.Synchronization.No
        self._input.max_acceleration = self._acceleration
        self._input.max_jerk = robot.limits.jerk
        self._answered: Vector | None = None
        self._wanted: Vector | None = None

    def step(self, wanted: Vector, velocity: Vector, acceleration: Vector) -> Vector:
        """Return the velocity (n,) one servo period on, rad/s.

        Args:
            wanted: velocity asked for (n,); beyond the caps it is clipped to them.
            velocity: of the reference (n,).
            acceleration: of the reference (n,).
        """
        request, answer = self._input, self._output
        if velocity is self._answered:
            answer.pass_to_input(request)  # nobody changed the last answer: cheaper than handing it over again
        else:
            request.current_velocity = velocity
            request.current_acceleration = np.minimum(np.maximum(acceleration, -self._acceleration), self._acceleration)
        if wanted is not self._wanted:
            request.target_velocity = np.minimum(np.maximum(wanted, -self.cap), self.cap)
            self._wanted = wanted
        self._generator.update(request, answer)
        self._answered = np.array(answer.new_velocity)
        return self._answered


class TorqueLimiter:
    """Clips torques to their caps, and their change to the rate caps."""

    def __init__(self, robot: Robot) -> None:
        self._cap = robot.limits.torque
        self._step = robot.limits.torque_rate * robot.period_ns * 1e-9

    def step(self, wanted: Vector, previous: Vector) -> Vector:
        """Return the torque (n,) to send, Nm, after `previous` was sent."""
        capped = np.minimum(np.maximum(wanted, -self._cap), self._cap)
        return np.minimum(np.maximum(capped, previous - self._step), previous + self._step)
