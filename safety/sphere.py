"""The bounding sphere as a linear row on joint velocities.

With h = r - |p - c| and n = (p - c)/|p - c|, dh/dt = -n J v. The row n J v <= k h lets the tool approach the surface
only as fast as the distance left allows (a control barrier function of relative degree one). Outside (h < 0) the
same row demands an inward speed of at least k |h|.
"""

import math
from typing import NamedTuple

import numpy as np

from robotctl.hal.profile import RobotProfile
from robotctl.hal.types import Vector

_CENTRE = 1e-3
"""Below this distance from the centre, m, the outward direction is undefined and the row cannot be active."""
_LARGEST_CORRECTION = 0.05
"""Speed at which a tool outside is led back at most, m/s."""


class Row(NamedTuple):
    """normal . v <= bound."""

    normal: Vector
    """(n,), m/rad"""
    bound: float
    """m/s"""


class BoundingSphere:
    """The sphere of a profile, shrunk by its margin."""

    def __init__(self, profile: RobotProfile) -> None:
        self.centre = np.array(profile.sphere.centre)
        self.radius = profile.sphere.radius - profile.safety.sphere_margin
        self.gain = profile.safety.sphere_gain
        self._square = self.radius**2

    def room(self, tool: Vector) -> float:
        """Return the distance from the point (3,) to the surface, m; negative outside."""
        offset = tool - self.centre
        return self.radius - math.sqrt(offset @ offset)

    def row(self, tool: Vector, jacobian: Vector) -> Row | None:
        """Return the row at a tool point (3,) with Jacobian (3, n); None at the centre."""
        offset = tool - self.centre
        distance = float(offset @ offset) ** 0.5
        if distance < _CENTRE:
            return None
        room = self.radius - distance
        return Row((offset @ jacobian) / distance, max(self.gain * room, -_LARGEST_CORRECTION))

    def project(self, velocity: Vector, tool: Vector, jacobian: Vector, horizon_s: float) -> Vector:
        """Return joint velocities (n,) after the projection rule of Gu et al. 2017, section on safety.

        If the tool would leave within `horizon_s`, its outward velocity is taken away and, outside, a velocity
        towards the centre is added: v' = v - max(0, n v) n - k max(0, |p - c| - r) n, q' = q + J^+ (v' - v).
        Gains are not published; k is the profile's `sphere_gain`.
        """
        offset = tool - self.centre
        distance = float(offset @ offset) ** 0.5
        motion = jacobian @ velocity
        ahead = offset + horizon_s * motion
        if distance < _CENTRE or float(ahead @ ahead) <= self._square:
            return velocity
        normal = offset / distance
        correction = -(max(0.0, float(normal @ motion)) + self.gain * max(0.0, distance - self.radius)) * normal
        damped = jacobian @ jacobian.T + 1e-6 * np.eye(3)
        return velocity + jacobian.T @ np.linalg.solve(damped, correction)
