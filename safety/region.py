"""Regions: where the tool point may be. A sphere that it may not leave, planes and boxes that it may not enter.

Each tells the room h(p) that is left, and the row that lets the tool approach its surface only as fast as that
allows. With n the direction in which room shrinks fastest, dh/dt = -n J v, and the row reads n J v <= k h: a control
barrier function of relative degree one. Outside (h < 0) the same row asks for a way back, at k |h|.
"""

import math
from abc import ABC, abstractmethod
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from robotctl.hal.profile import KeepOutBox, KeepOutPlane, RobotProfile
from robotctl.hal.types import Vector

_CENTRE = 1e-3
"""Closer to a sphere's centre than this, m, the outward direction is undefined and the row cannot be active."""
_LARGEST_CORRECTION = 0.05
"""Speed at which a tool outside is led back at most, m/s."""


class Row(NamedTuple):
    """normal . v <= bound."""

    normal: Vector
    """(n,), m/rad"""
    bound: float
    """m/s"""

    @staticmethod
    def keeping(room: float, gain: float, normal: Vector) -> "Row":
        """Return the row that lets room shrink by `gain` times itself, m/s, or asks for it back where it is negative.

        Args:
            normal: how fast room shrinks with each joint (n,), m/rad.
        """
        return Row(normal, max(gain * room, -_LARGEST_CORRECTION))


class Region(ABC):
    """Where the tool point may be. Points are (3,), m, in the base frame."""

    name: str

    def __init__(self, name: str, gain: float) -> None:
        self.name = name
        self.gain = gain
        """Largest approach speed per metre of room, 1/s."""

    @abstractmethod
    def room(self, point: Vector) -> float:
        """Return how far the point may still go in the worst direction, m; negative outside."""

    @abstractmethod
    def outward(self, point: Vector) -> Vector | None:
        """Return the unit vector (3,) along which room shrinks fastest; None where there is none."""

    def bend(self, point: Vector, velocity: Vector) -> float:
        """Return a bound on how much faster than linearly room shrinks along a motion, m/s^2.

        On a path with acceleration a, room'' >= -(outward . a) - bend.
        """
        return 0.0

    @abstractmethod
    def along(self, path: Vector) -> float:
        """Return a lower bound on the room anywhere on the straight lines between points (m, 3), m."""

    def row(self, point: Vector, jacobian: Vector) -> Row | None:
        """Return the row at a point with Jacobian (3, n); None where there is no outward direction."""
        outward = self.outward(point)
        if outward is None:
            return None
        return Row.keeping(self.room(point), self.gain, outward @ jacobian)


class Sphere(Region):
    """The ball that the tool point may not leave: h = r - |p - c|, n = (p - c)/|p - c|."""

    def __init__(self, name: str, gain: float, centre: Vector, radius: float) -> None:
        super().__init__(name, gain)
        self.centre = centre
        self.radius = radius

    def room(self, point: Vector) -> float:
        offset = point - self.centre
        return self.radius - math.sqrt(offset @ offset)

    def outward(self, point: Vector) -> Vector | None:
        offset = point - self.centre
        distance = math.sqrt(offset @ offset)
        return None if distance < _CENTRE else offset / distance

    def bend(self, point: Vector, velocity: Vector) -> float:
        """Return |v_t|^2 / |p - c|, v_t being the part of the velocity along the surface."""
        outward = self.outward(point)
        if outward is None:
            return 0.0
        return float(velocity @ velocity - (outward @ velocity) ** 2) / (self.radius - self.room(point))

    def along(self, path: Vector) -> float:
        offsets = path - self.centre
        return self.radius - math.sqrt((offsets * offsets).sum(axis=1).max())

    def project(self, velocity: Vector, point: Vector, jacobian: Vector, horizon_s: float) -> Vector:
        """Return joint velocities (n,) after the projection rule of Gu et al. 2017, section on safety.

        If the tool would leave within `horizon_s`, its outward velocity is taken away and, outside, a velocity
        towards the centre is added: v' = v - max(0, n v) n - k max(0, |p - c| - r) n, q' = q + J^+ (v' - v).
        Gains are not published; k is this region's.
        """
        motion = jacobian @ velocity
        normal = self.outward(point)
        if normal is None or self.room(point + horizon_s * motion) >= 0.0:
            return velocity
        correction = -(max(0.0, float(normal @ motion)) + self.gain * max(0.0, -self.room(point))) * normal
        damped = jacobian @ jacobian.T + 1e-6 * np.eye(3)
        return velocity + jacobian.T @ np.linalg.solve(damped, correction)


class Plane(Region):
    """The half-space that the tool point may not enter: h = -n (p - p0) - clearance, n pointing into it."""

    def __init__(self, name: str, gain: float, point: Vector, inward: Vector, clearance: float) -> None:
        super().__init__(name, gain)
        self._outward = -inward / math.sqrt(inward @ inward)
        self._level = float(self._outward @ point) - clearance

    def room(self, point: Vector) -> float:
        return self._level - float(self._outward @ point)

    def outward(self, point: Vector) -> Vector:
        return self._outward

    def along(self, path: Vector) -> float:
        return self._level - float((path @ self._outward).max())


class Box(Region):
    """The box that the tool point may not enter: h is the signed distance to its surface, less the clearance.

    That distance is convex, so nothing bends, and the plane through the nearest point of the box bounds it from below.
    """

    def __init__(
        self, name: str, gain: float, centre: Vector, half: Vector, rotation: Vector, clearance: float
    ) -> None:
        super().__init__(name, gain)
        self._centre = centre
        self._half = half.tolist()
        self._rotation = rotation
        """From the box's frame to the base frame (3, 3)."""
        self._clearance = clearance

    def room(self, point: Vector) -> float:
        distance, _ = self._nearest(((point - self._centre) @ self._rotation).tolist())
        return distance - self._clearance

    def outward(self, point: Vector) -> Vector:
        _, away = self._nearest(((point - self._centre) @ self._rotation).tolist())
        return -(self._rotation @ away)

    def along(self, path: Vector) -> float:
        points = ((path - self._centre) @ self._rotation).tolist()
        least = math.inf
        for start, end in pairwise(points):
            distance, away = self._nearest(start)
            ahead = distance + sum(n * (q - p) for n, p, q in zip(away, start, end, strict=True))
            least = min(least, distance, ahead)
        return least - self._clearance

    def _nearest(self, local: list[float]) -> tuple[float, list[float]]:
        """Return a point's signed distance to the surface and the unit vector away from it, in the box's frame.

        In plain floats, which for three numbers are several times faster than arrays.
        """
        beyond = [abs(x) - half for x, half in zip(local, self._half, strict=True)]
        furthest = max(beyond)
        if furthest > 0.0:
            away = [max(x, 0.0) for x in beyond]
            distance = length = math.hypot(*away)
        else:  # inside the box, the way out is through the nearest face
            away = [0.0, 0.0, 0.0]
            away[beyond.index(furthest)] = 1.0
            distance, length = furthest, 1.0
        return distance, [math.copysign(x / length, at) for x, at in zip(away, local, strict=True)]


def regions(profile: RobotProfile, margin: float = 0.0) -> tuple[Sphere, *tuple[Region, ...]]:
    """Return the regions of a profile, the sphere first, each with `margin` less room than the profile gives, m."""
    gain, sphere = profile.safety.sphere_gain, profile.sphere
    ball = Sphere("sphere", gain, np.array(sphere.centre), sphere.radius - margin)
    return (ball, *(_keep_out(item, gain, margin) for item in profile.keep_out))


def _keep_out(item: KeepOutPlane | KeepOutBox, gain: float, margin: float) -> Region:
    clearance = item.clearance + margin
    if isinstance(item, KeepOutPlane):
        return Plane(item.name, gain, np.array(item.point), np.array(item.normal), clearance)
    return Box(item.name, gain, np.array(item.centre), np.array(item.half), rotation(*item.rpy), clearance)


def rotation(roll: float, pitch: float, yaw: float) -> Vector:
    """Return the rotation matrix (3, 3) of a turn about the fixed axes x, then y, then z, rad (as in URDF)."""
    (sr, sp, sy), (cr, cp, cy) = np.sin((roll, pitch, yaw)), np.cos((roll, pitch, yaw))
    about_x = np.array([[1.0, 0.0, 0.0], [0.0, cr, -sr], [0.0, sr, cr]])
    about_y = np.array([[cp, 0.0, sp], [0.0, 1.0, 0.0], [-sp, 0.0, cp]])
    about_z = np.array([[cy, -sy, 0.0], [sy, cy, 0.0], [0.0, 0.0, 1.0]])
    return np.asarray(about_z @ about_y @ about_x)
