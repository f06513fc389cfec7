"""What regions and links allow the acceleration, so that the arm can be stopped before it touches them.

The arm is looked at in three poses ahead: y(q, v) after a reaction time, and where braking at all or at half of the
acceleration cap would end. With dy/dt = v + D(v) a, D being how long each joint moves on its way there, the rows

    n J(y) (v + D a) <= k h(y)

let each of these poses approach a surface only as fast as the room h that is left there. Braking keeps the poses
where it ends in place, so the rows can be kept until the arm stands.
"""

from typing import NamedTuple, Protocol

import numpy as np

from robotctl.hal.robot import Robot
from robotctl.hal.types import Vector
from robotctl.safety.proximity import NothingNear, ProximityLimit, Scene
from robotctl.safety.region import regions
from robotctl.safety.shaper import Clip, ToolModel

BRAKE_SHARES = (1.0, 0.5)
"""Shares of the acceleration cap at which stops are looked ahead to."""


class Geometry(ToolModel, Protocol):
    """What has to be known of the arm's geometry."""

    def tool_and_jacobian(self, position: Vector) -> tuple[Vector, Vector]: ...


class Rows(NamedTuple):
    """Rows on the joints' acceleration, normals @ a <= bounds."""

    normals: Vector
    """(m, n)"""
    bounds: Vector
    """(m,)"""
    flags: list[Clip]
    """What is behind each."""


class Lookahead:
    """Looks ahead for one robot. Remembers clearances only."""

    def __init__(self, robot: Robot, model: Geometry, reaction_s: float, scene: Scene | None) -> None:
        self._model = model
        self._reaction = reaction_s
        bounds = regions(robot.profile, robot.profile.safety.sphere_margin)
        self._regions = list(zip(bounds, [Clip.SPHERE] + (len(bounds) - 1) * [Clip.KEEP_OUT], strict=True))
        usable = (1.0 - robot.profile.safety.cap_margin) * robot.limits.acceleration
        # How long each joint brakes for per rad/s, on the way to each pose (3, n).
        self._braking = np.array([np.zeros(robot.dof)] + [1.0 / (share * usable) for share in BRAKE_SHARES])
        self._proximity = ProximityLimit(robot, scene or NothingNear(robot.dof))

    def rows(self, position: Vector, velocity: Vector) -> Rows:
        """Return the rows for a motion, joint positions (n,), rad, and velocities (n,), rad/s."""
        rest = self._braking * np.abs(velocity)
        poses = position + (self._reaction + 0.5 * rest) * velocity
        normals, bounds, flags, at = [], [], [], []
        for index, links in enumerate(self._proximity.rows(poses)):
            point, jacobian = self._model.tool_and_jacobian(poses[index])
            found = [(region.row(point, jacobian), flag) for region, flag in self._regions]
            for row, flag in found + [(row, Clip.PROXIMITY) for row in links]:
                if row is not None:
                    normals.append(row.normal)
                    bounds.append(row.bound)
                    flags.append(flag)
                    at.append(index)
        here = np.array(normals).reshape(len(normals), len(position))
        return Rows(here * (self._reaction + rest[at]), np.array(bounds) - here @ velocity, flags)
