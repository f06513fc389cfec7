"""What acts on the joints beside their drives: the generalised momentum observer of De Luca and Mattone (2003).

With the momentum p = M(q) v, its known part changes at b = tau + C^T v - g - friction. The residual
r = K (p - integral of (b + r)) follows the torque that b does not know, first order with time constant 1/K, and needs
no acceleration. The integral is taken backwards (Euler), so that a late sample cannot make it unstable.
"""

from typing import Protocol

import numpy as np

from robotctl.hal.types import Sample, Vector

GAIN = 200.0
"""1/s. Noise of the measured velocity shows in the residual as this many times M dv."""
CREEP = 0.02
"""Speed above which dry friction is taken to act fully, rad/s."""


class Dynamics(Protocol):
    """What the observer has to know of the arm. Arrays are (n,) and (n, n)."""

    damping: Vector
    """Viscous friction, Nms/rad."""
    friction: Vector
    """Dry friction, Nm."""

    def mass_matrix(self, position: Vector) -> Vector: ...
    def coriolis(self, position: Vector, velocity: Vector) -> Vector: ...
    def gravity(self, position: Vector) -> Vector: ...


class MomentumObserver:
    """Estimates the external torques (n,), Nm, of one arm."""

    def __init__(self, dof: int, model: Dynamics) -> None:
        self.external: Vector = np.zeros(dof)
        """The residual after the last sample; dry friction that holds a joint at rest shows in it."""
        self._model = model
        self._rest = np.zeros(dof)
        self._momentum: Vector | None = None
        self._stamps = np.zeros(dof, dtype=np.int64)

    def step(self, sample: Sample) -> Vector:
        """Take the next sample and return the residual. With the drives off the observer starts anew, from zero."""
        position, velocity = sample.position, sample.velocity
        model = self._model
        elapsed = 1e-9 * (sample.joint_stamp_ns - self._stamps)
        self._stamps = sample.joint_stamp_ns
        momentum = model.mass_matrix(position) @ velocity
        own = model.coriolis(position, velocity).T @ velocity - model.gravity(position)
        own -= model.damping * velocity + model.friction * np.tanh(velocity / CREEP)
        if self._momentum is None or not sample.enabled:
            self._momentum = momentum if sample.enabled else None
            self.external = self._rest
            self._own = own
            return self.external
        expected = self._momentum + elapsed * (sample.effort + 0.5 * (self._own + own))
        self.external = GAIN * (momentum - expected) / (1.0 + GAIN * elapsed)
        self._momentum = expected + elapsed * self.external
        self._own = own
        return self.external
