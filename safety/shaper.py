"""The shaper: turns any wanted joint velocity into one that keeps all limits, now and until the arm has stopped.

It works on the reference, the motion the drives are led along, in steps of one servo period with constant
acceleration: q' = q + dt (v + v')/2. Three things hold for the v' it returns:

1. it lies in a box: velocity caps, acceleration caps, and per joint a bound from which braking at the acceleration
   cap ends at the soft limit;
2. it is the velocity in that box closest to the wanted one that keeps the row of every region and of every pair of
   links that is near (one QP; for the sphere there is the named alternative `projection`);
3. braking every joint at its cap from the next reference keeps the tool inside every region and the links apart.
   Where a candidate fails that, the shaper brakes instead, which is the very motion that the previous step proved;
   so the claim carries over from step to step, whatever is asked for.
"""

from enum import IntFlag
from typing import NamedTuple, Protocol

import daqp
import numpy as np

from robotctl.hal.robot import Robot
from robotctl.hal.types import Vector
from robotctl.safety.box import JointBox
from robotctl.safety.proximity import NothingNear, ProximityLimit, Scene
from robotctl.safety.region import Region, Row, regions

_SOFT = 8
"""daqp's sense of a constraint that gives way, at a price, rather than make the problem infeasible."""
SOLVED = (1, 2)
"""daqp's exit flags for an optimum, and for an optimum with a softened constraint."""


_SAMPLES = np.linspace(0.125, 1.0, 8)[:, np.newaxis]
"""Where along the time to rest links are looked at on a predicted stop ..."""
_TOOL = slice(1, None, 2)
"""... and which of these do for the tool, whose regions see to what lies between."""
_ROUNDING = 1e-9
"""m"""
_SINGULAR = 1e-3
"""Square of a row's normal, (m/rad)^2, below which a way back would ask for too much of the joints."""


class ToolModel(Protocol):
    """What the shaper has to know of the arm's geometry."""

    @property
    def reach(self) -> Vector:
        """A bound on the distance between the tool point and each joint's axis (n,), m."""
        ...

    def tool(self, position: Vector) -> Vector:
        """Return the tool point (3,), m, at joint positions (n,)."""
        ...


class Clip(IntFlag):
    """Why a velocity or a torque differs from the one that was wanted."""

    NONE = 0
    VELOCITY = 1
    POSITION = 2
    SPHERE = 4
    PREDICTED_STOP = 8
    RECOVERY = 16
    """Not a limit: the arm began outside its limits, and only a retreat may move it."""
    KEEP_OUT = 32
    PROXIMITY = 64
    ACCELERATION = 128
    TORQUE = 256


class Shaped(NamedTuple):
    """The shaper's answer."""

    velocity: Vector
    """(n,), rad/s"""
    clip: Clip


class Shaper:
    """Shapes the velocities of one robot. Holds scratch memory only; every call stands for itself."""

    def __init__(self, robot: Robot, model: ToolModel, scene: Scene | None = None) -> None:
        """Shape for a robot's limits; with a `scene`, for its clearances, too."""
        safety = robot.profile.safety
        self._dt = robot.period_ns * 1e-9
        self._tool = model.tool
        self._box = JointBox(robot, self._dt, 1.0 - safety.cap_margin)
        self.velocity_cap = self._box.velocity_cap
        self.acceleration_cap = self._box.acceleration_cap
        self.regions = regions(robot.profile, safety.sphere_margin)
        self._sphere = self.regions[0]
        self._gain = safety.sphere_gain
        self._projects = safety.sphere == "projection"
        self._rowed = self.regions[1:] if self._projects else self.regions
        scene = scene or NothingNear(robot.dof)
        self._proximity = ProximityLimit(robot, scene)
        self._n = robot.dof
        self._half_dt = 0.5 * self._dt
        self._half_brake = 0.5 / self.acceleration_cap
        # With this, speed @ reach bounds the tool's speed.
        self._reach = model.reach
        self._hessian = np.eye(self._n)
        # Where braking within the acceleration caps cannot keep the rows, the rows give way, not the caps.
        firm = np.zeros(self._n + len(self.regions) + len(scene.pairs), dtype=np.int32)
        giving = firm.copy()
        giving[self._n :] = _SOFT
        self._senses = (firm, giving)

    def step(self, position: Vector, velocity: Vector, wanted: Vector, tool: Vector, jacobian: Vector) -> Shaped:
        """Return the reference velocity of the next step.

        Args:
            position: reference (n,), rad.
            velocity: reference (n,), rad/s.
            wanted: velocity to come as close to as the limits allow (n,), rad/s, finite.
            tool: tool point at `position` (3,), m.
            jacobian: its translational Jacobian (3, n).
        """
        lower, upper = self._box.bounds(position, velocity)
        best, clip = np.minimum(np.maximum(wanted, lower), upper), Clip.NONE
        if (best == wanted).all():
            best = wanted
        else:
            clip = Clip.POSITION if (np.abs(wanted) <= self.velocity_cap).all() else Clip.VELOCITY
        rooms = [(region.room(tool), region) for region in self.regions]
        links, required = self._proximity.look(position)
        if links or self._gain * min(room for room, _ in rooms) < np.abs(best) @ self._reach:
            best, touched = self._keep_rows(best, wanted, lower, upper, tool, jacobian, links)
            clip |= touched
        if not self._stops(position, velocity, best, tool, rooms, required):
            clip |= Clip.PREDICTED_STOP
            best = self.brake(velocity)
        return Shaped(best, clip)

    def brake(self, velocity: Vector) -> Vector:
        """Return the velocity after one step of braking every joint at its cap."""
        step = self._box.step
        return velocity - np.minimum(np.maximum(velocity, -step), step)

    def _keep_rows(
        self,
        best: Vector,
        wanted: Vector,
        lower: Vector,
        upper: Vector,
        tool: Vector,
        jacobian: Vector,
        links: list[Row],
    ) -> Shaped:
        """Return the velocity in the box closest to the wanted one that keeps all rows, `best` if that does."""
        clip = Clip.NONE
        if self._projects:
            projected = self._sphere.project(best, tool, jacobian, self._dt)
            if projected is not best:
                clip = Clip.SPHERE
                scale = float((np.abs(projected) / self.velocity_cap).max())
                wanted = best = np.minimum(np.maximum(projected / max(1.0, scale), lower), upper)
        rows = [(row, Clip.PROXIMITY) for row in links]
        for region in self._rowed:
            row = region.row(tool, jacobian)
            if row is not None:
                rows.append((row, Clip.SPHERE if region is self._sphere else Clip.KEEP_OUT))
        broken = [flag for row, flag in rows if float(row.normal @ best) > row.bound]
        for flag in broken:
            clip |= flag
        return Shaped(self._solve(wanted, lower, upper, [row for row, _ in rows]) if broken else best, clip)

    def _solve(self, wanted: Vector, lower: Vector, upper: Vector, rows: list[Row]) -> Vector:
        """Return the velocity in the box closest to the wanted one that keeps all rows.

        Of a row with a negative bound, whose room is used up, no more is demanded than to get no worse, or two of them
        could ask for what cannot be had. The way back is wanted: the wish is changed to go at the bound.
        """
        for normal, bound in rows:
            if bound < min(0.0, float(normal @ wanted)):
                wanted = wanted - normal * ((normal @ wanted - bound) / (normal @ normal + _SINGULAR))
        normals = np.array([row.normal for row in rows])
        most = np.concatenate([upper, [max(0.0, row.bound) for row in rows]])
        least = np.concatenate([lower, np.full(len(rows), -np.inf)])
        for sense in self._senses:
            solution, _, flag, _ = daqp.solve(self._hessian, -wanted, normals, most, least, sense[: len(most)])
            if flag in SOLVED:
                return np.asarray(np.minimum(np.maximum(solution, lower), upper))
        return np.minimum(np.maximum(np.zeros(self._n), lower), upper)

    def _stops(
        self,
        position: Vector,
        velocity: Vector,
        following: Vector,
        tool: Vector,
        rooms: list[tuple[float, Region]],
        required: Vector,
    ) -> bool:
        """Return whether tool and links keep clear while every joint brakes at its cap from `following`.

        The joints do not come to rest together, so the way is sampled in time, not between its ends. Already
        outside, the tool may get no further out.
        """
        speed = np.abs(following)
        way = self._half_dt * (np.abs(velocity) + speed) + speed * speed * self._half_brake
        reached = way @ self._reach
        near = [(room, region) for room, region in rooms if room < reached]
        clear = self._proximity.clear(position, way, required)
        if clear and not near:
            return True
        rest = speed / self.acceleration_cap
        times = np.minimum(_SAMPLES * rest.max(), rest)
        start = position + self._half_dt * (velocity + following)
        poses = start + times * (following - 0.5 * times * np.copysign(self.acceleration_cap, following))
        if near:
            path = np.array([tool, *(self._tool(pose) for pose in poses[_TOOL])])
            if any(region.along(path) < min(0.0, room) - _ROUNDING for room, region in near):
                return False
        return clear or self._proximity.keeps(np.concatenate([position[np.newaxis], poses]), required)
