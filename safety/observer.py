"""What acts on the joints beside their drives: the generalised momentum observer of De Luca and Mattone (2003).

With the momentum p = M(q) v, the model knows dp/dt = tau + C^T v - g - D v. The residual r = K (p - integral of the
known part and of r itself) follows the torque that the model does not know, first order with time constant 1/K, and
needs no acceleration. Dry friction is part of what it finds: a model of that is worth little where it changes sign.
"""

from typing import Protocol

import numpy as np

from robotctl.hal.types import Sample, Vector

_GAIN = 200.0
"""1/s. A velocity that is wrong by dv shows in the residual as up to K M dv."""


_LONGEST_S = 0.01
"""Time between two samples over which torques are not followed any more, s: the residual stays, and starts anew."""


class Dynamics(Protocol):
    """What has to be known of the arm's dynamics. Arrays are (n,), of matrices (n, n)."""

    damping: Vector
    """Viscous friction, Nms/rad."""

    def mass_matrix(self, position: Vector) -> Vector: ...
    def coriolis(self, position: Vector, velocity: Vector) -> Vector: ...
    def gravity(self, position: Vector) -> Vector: ...
    def bias(self, position: Vector, velocity: Vector) -> Vector: ...


class MomentumObserver:
    """Estimates the torques (n,), Nm, that act on one arm from outside, and those that its model is wrong by."""

    def __init__(self, dof: int, model: Dynamics) -> None:
        self.external: Vector = np.zeros(dof)
        """The residual after the last sample."""
        self._model = model
        self._nothing = self.external
        self._before: tuple[Vector, Vector] | None = None
        """Expected momentum at the last sample, and the model's part of its change."""
        self._stamps = np.zeros(dof, dtype=np.int64)

    def step(self, sample: Sample) -> Vector:
        """Take the next sample and return the residual. With the drives off it is zero, and starts anew from there.

        The effort of a sample is taken to have acted since the one before. However late a sample comes, the residual
        stays stable, since the step is implicit in it.
        """
        if not sample.enabled:
            self._before, self.external = None, self._nothing
            return self.external
        model, position, velocity = self._model, sample.position, sample.velocity
        momentum = model.mass_matrix(position) @ velocity
        own = model.coriolis(position, velocity).T @ velocity - model.gravity(position) - model.damping * velocity
        elapsed = 1e-9 * (sample.joint_stamp_ns - self._stamps)
        if self._before is not None and elapsed.max() < _LONGEST_S:
            if elapsed.min() <= 0.0:
                return self.external  # a joint was not heard of: its momentum would be made up
            expected, own_before = self._before
            # The trapezoidal rule: with the model at one end only, the residual would be off by dt/2 of its change.
            expected = expected + elapsed * (sample.effort + 0.5 * (own_before + own))
            self.external = _GAIN * (momentum - expected) / (1.0 + _GAIN * elapsed)
            momentum = expected + elapsed * self.external
        self._before, self._stamps = (momentum, own), sample.joint_stamp_ns
        return self.external

    def present(self, sample: Sample, torque: Vector) -> tuple[Vector, Vector]:
        """Return where the joints are by now (n,), rad, and how they move (n,), rad/s.

        A sample that came over a bus tells how they moved when they were heard of; since then, `torque` has acted.
        """
        model, position, velocity = self._model, sample.position, sample.velocity
        age = 1e-9 * (sample.stamp_ns - sample.joint_stamp_ns)
        force = torque + self.external - model.bias(position, velocity) - model.damping * velocity
        inertia = model.mass_matrix(position) + np.diag(age * model.damping)
        change = age * np.linalg.solve(inertia, force)
        return position + age * (velocity + 0.5 * change), velocity + change
