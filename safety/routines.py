"""Reset routines: small motions the supervisor runs by itself, through the same limiter and shaper as a policy.

| | routine       | what it does                                                        |
|-|---------------|---------------------------------------------------------------------|
|R0| `Settle`      | waits for measured standstill                                       |
|R1| `Retreat`     | leads joints, tool and links back inside, at a tenth of the caps    |
|R2| `Goto`        | leads the joints straight to a pose (home, rest)                    |
|R4| `RandomStart` | the same, to a pose drawn around home                               |
"""

from abc import ABC, abstractmethod
from typing import Protocol

import numpy as np

from robotctl.hal.errors import ConfigError
from robotctl.hal.robot import Robot
from robotctl.hal.types import Sample, Vector
from robotctl.safety.proximity import NothingNear, Scene
from robotctl.safety.region import regions

_GAIN = 3.0
"""Approach speed per rad of distance left, 1/s."""
_ARRIVED = 2e-3
"""rad"""
_RETREAT_SCALE = 0.1
"""Part of the caps that a retreat uses at most."""
_CRAWL = 0.2
"""Part of that which it uses at least, so that the end is reached."""
_RETREAT_DEPTH = 0.01
"""How far inside a boundary a retreat ends, m and rad."""
_CLEARANCE = 2e-3
"""Beyond what the shaper keeps, m. No more, since some links are never far from each other."""
_AIM = 0.8
"""Share of the tool's largest speed that a motion aims at ..."""
_FAST = 0.9
"""... and above which it slows down, in every tick to ..."""
_SLOWER = 0.8
"""... so much, until it may get faster again, in every tick by ..."""
_FASTER = 0.005
"""... so much of its pace."""
_START_ROOM = 0.02
"""How far inside every region the tool is at a random start, m."""
_DRAWS = 100


class Geometry(Protocol):
    """What the routines have to know of the arm."""

    def tool_and_jacobian(self, position: Vector) -> tuple[Vector, Vector]: ...


class Routine(ABC):
    """One reset motion. Asked in every tick; it never blocks."""

    name: str
    timeout_s: float

    @abstractmethod
    def velocity(self, sample: Sample, position: Vector) -> Vector | None:
        """Return the wanted joint velocity (n,), rad/s, at reference `position`; None when done."""


class Settle(Routine):
    """R0: nothing moves until the measured joints are at rest."""

    name = "settle"

    def __init__(self, robot: Robot) -> None:
        self.timeout_s = 2.0 + robot.stopping_time_s
        self._standstill = robot.profile.safety.standstill
        self._rest = np.zeros(robot.dof)

    def velocity(self, sample: Sample, position: Vector) -> Vector | None:
        return None if bool((np.abs(sample.velocity) < self._standstill).all()) else self._rest


class Retreat(Routine):
    """R1: back inside the joint limits and all regions, and links apart, slowly, straight along the gradient."""

    name = "retreat"
    timeout_s = 30.0

    def __init__(self, robot: Robot, geometry: Geometry, scene: Scene | None = None) -> None:
        safety = robot.profile.safety
        margin = safety.position_margin + _RETREAT_DEPTH
        self._lower = robot.limits.lower + margin
        self._upper = robot.limits.upper - margin
        self._cap = _RETREAT_SCALE * robot.limits.velocity
        self._geometry = geometry
        self._regions = regions(robot.profile, safety.sphere_margin)
        self._scene = scene or NothingNear(robot.dof)
        self._clear = safety.proximity_stop + safety.proximity_margin + _CLEARANCE

    def velocity(self, sample: Sample, position: Vector) -> Vector | None:
        inside = np.minimum(np.maximum(position, self._lower), self._upper)
        wanted = _GAIN * (inside - position)
        tool, jacobian = self._geometry.tool_and_jacobian(position)
        outside = _RETREAT_DEPTH - min(region.room(tool) for region in self._regions)
        damped = jacobian @ jacobian.T + 1e-3 * np.eye(3)
        for region in self._regions:
            short, outward = _RETREAT_DEPTH - region.room(tool), region.outward(tool)
            if short > 0.0 and outward is not None:
                wanted = wanted - jacobian.T @ np.linalg.solve(damped, _GAIN * short * outward)
        clearances = self._scene.measure(position, range(len(self._scene.pairs)))
        tight = np.flatnonzero(clearances < self._clear).tolist()
        for pair, slope in zip(tight, self._scene.approach(position, tight), strict=True):
            wanted = wanted - slope * (_GAIN * (self._clear - clearances[pair]) / (slope @ slope + 1e-3))
        if float(np.abs(inside - position).max()) < _ARRIVED and outside < 0.2 * _RETREAT_DEPTH and not tight:
            return None
        fastest = float((np.abs(wanted) / self._cap).max())
        return wanted * (min(max(fastest, _CRAWL), 1.0) / fastest) if fastest > 0.0 else wanted


class Goto(Routine):
    """R2: a straight line in joint space, all joints arriving together."""

    timeout_s = 60.0

    def __init__(self, robot: Robot, pose: Vector, name: str, geometry: Geometry) -> None:
        safety = robot.profile.safety
        self.name = name
        self._pose = pose
        self._cap = safety.reset_scale * robot.limits.velocity
        self._tool_speed = safety.reset_tool_speed
        self._geometry = geometry
        self._pace = 1.0

    def velocity(self, sample: Sample, position: Vector) -> Vector | None:
        error = self._pose - position
        if float(np.abs(error).max()) < _ARRIVED:
            return None
        wanted = _GAIN * error
        _, jacobian = self._geometry.tool_and_jacobian(position)
        # Where it slides along a bound, the shaper leads joints another way than they want, and the tool may get fast.
        hurry = float(np.linalg.norm(jacobian @ sample.velocity)) > _FAST * self._tool_speed
        self._pace = _SLOWER * self._pace if hurry else min(self._pace + _FASTER, 1.0)
        speed = float(np.linalg.norm(jacobian @ wanted)) / (_AIM * self._tool_speed)
        return wanted * (self._pace / max(1.0, speed, float((np.abs(wanted) / self._cap).max())))


class RandomStart(Goto):
    """R4: to a pose drawn evenly from the box of `start_spread` around home; the same for the same seed."""

    def __init__(self, robot: Robot, seed: int, geometry: Geometry, scene: Scene | None = None) -> None:
        """Draw the pose, again if a joint, the tool or a link would be where a policy should not begin.

        Raises:
            ConfigError: if the seed is negative, or the box holds hardly a pose that may be.
        """
        if seed < 0:
            raise ConfigError(f"seed {seed} is negative", "use one from 0 on")
        pose = _draw(robot, np.random.default_rng(seed), geometry, scene or NothingNear(robot.dof))
        super().__init__(robot, pose, f"random start {seed}", geometry)


def _draw(robot: Robot, rng: np.random.Generator, geometry: Geometry, scene: Scene) -> Vector:
    profile, limits, safety = robot.profile, robot.limits, robot.profile.safety
    allowed = regions(profile, safety.sphere_margin + _START_ROOM)
    clear = safety.proximity_stop + safety.proximity_margin + _CLEARANCE
    for _ in range(_DRAWS):
        pose = profile.home + rng.uniform(-profile.start_spread, profile.start_spread, robot.dof)
        room = np.minimum(pose - limits.lower, limits.upper - pose).min() - safety.position_margin
        tool, _ = geometry.tool_and_jacobian(pose)
        if min(room, *(region.room(tool) for region in allowed)) < 0.0:
            continue
        if (scene.measure(pose, range(len(scene.pairs))) >= clear).all():
            return np.asarray(pose)
    raise ConfigError(f"no random start found in {_DRAWS} draws", "make start_spread smaller, or move home inwards")
