"""The reference: the motion the drives are led along, and the command that leads them.

One step integrates q' = q + dt (v + v')/2 and feeds the drives forward with the inverse dynamics and friction of
that motion, so that tracking needs little of the gains. What the model does not know, such as a payload, is found
by a slow integrator, which only works at rest: while the arm moves, an actuator's lag would wind it up.
"""

import numpy as np

from robotctl.control.kinematics import Kinematics
from robotctl.hal.robot import Robot
from robotctl.hal.types import Command, CommandMode, Vector

_SLOW = 0.02
"""Reference speed below which friction feed-forward fades and the integrator works, rad/s."""
_DEADBAND = 1e-3
"""Position error that the integrator leaves alone, rad: dry friction would make it hunt."""
_BIAS_SHARE = 0.3
"""Largest part of a joint's torque that the integrator may use."""


class Reference:
    """Reference position, velocity and acceleration of all joints, each (n,)."""

    def __init__(self, robot: Robot, kinematics: Kinematics) -> None:
        n = robot.dof
        self.position: Vector = np.zeros(n)
        self.velocity: Vector = np.zeros(n)
        self.acceleration: Vector = np.zeros(n)
        self.effort: Vector = np.zeros(n)
        """Feed-forward of the last command (n,), Nm."""
        self._dt = robot.period_ns * 1e-9
        self._kinematics = kinematics
        self._ki = self._dt * np.array([joint.gains.ki for joint in robot.profile.joints])
        self._cap = robot.limits.torque
        self._bias_cap = _BIAS_SHARE * self._cap
        self._bias = np.zeros(n)
        self._velocity_cap = robot.limits.velocity
        self._rubs = bool(kinematics.friction.any())

    def resync(self, position: Vector, velocity: Vector) -> None:
        """Start anew from a measured state, as after any loss of hold. What the integrator had found is forgotten."""
        self.position = np.array(position)
        self.velocity = np.minimum(np.maximum(velocity, -self._velocity_cap), self._velocity_cap)
        self.acceleration = np.zeros_like(self.position)
        self._bias = np.zeros_like(self.position)

    def mark(self) -> tuple[Vector, ...]:
        """Return what `restore` needs to come back here."""
        return self.position, self.velocity, self.acceleration, self.effort, self._bias

    def restore(self, mark: tuple[Vector, ...]) -> None:
        """Come back to where `mark` was called."""
        self.position, self.velocity, self.acceleration, self.effort, self._bias = mark

    def step(self, velocity: Vector, measured: Vector) -> Command:
        """Advance one servo period to `velocity` and return the command for it.

        Args:
            velocity: shaped reference velocity at the end of the period (n,), rad/s.
            measured: joint positions (n,), rad.
        """
        dt, kinematics = self._dt, self._kinematics
        self.acceleration = (velocity - self.velocity) / dt
        self.position = self.position + (0.5 * dt) * (self.velocity + velocity)
        self.velocity = velocity
        effort = kinematics.inverse_dynamics(self.position, velocity, self.acceleration)
        effort += kinematics.damping * velocity + self._bias
        if self._rubs:
            effort += kinematics.friction * np.tanh(velocity / _SLOW)
        if velocity @ velocity < _SLOW**2:
            self._integrate(measured)
        self.effort = np.minimum(np.maximum(effort, -self._cap), self._cap)
        return Command(CommandMode.TRACK, self.position, velocity, self.effort)

    def _integrate(self, measured: Vector) -> None:
        error = self.position - measured
        # Written so that a measurement that is no number adds nothing: every later command would be none either.
        bias = self._bias + self._ki * np.where(np.abs(error) > _DEADBAND, error, 0.0)
        self._bias = np.minimum(np.maximum(bias, -self._bias_cap), self._bias_cap)
