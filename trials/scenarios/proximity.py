"""P20: an obstacle beside the tool."""

from dataclasses import replace
from functools import lru_cache
from itertools import product

import numpy as np

from robotctl.control.collision import CollisionModel
from robotctl.control.kinematics import Kinematics
from robotctl.hal.profile import KeepOutBox
from robotctl.hal.robot import Robot, load_robot
from robotctl.hal.types import Vector
from robotctl.safety.region import regions
from robotctl.safety.shaper import Clip
from robotctl.safety.trip import Category, Protection
from robotctl.trials.bench import Bench
from robotctl.trials.clearing import Clears
from robotctl.trials.faults import Planted, pulled
from robotctl.trials.policies import Act
from robotctl.trials.poses import outside
from robotctl.trials.scenario import Scenario, Trial
from robotctl.trials.shaping import clipped, shaped_scenario
from robotctl.trials.stops import Expected, still, stop_scenario, untouchable

_NAME = "obstacle"
_HALF = 0.05
"""Half a side of the box, m."""
_GAP = 0.05
"""Clearance that the arm has at home, at least, m."""
_FARTHEST = 0.4
_TOLERANCE = 2e-3
"""By how much the true clearance may fall short of `proximity_stop`, m."""
_STEP = 2e-4
_FARTHEST_POSE = 0.8
"""rad from home"""
_ROOM = 0.02
"""rad and m"""
_BEFORE = 0.03
_BESIDE = 5e-4
_PULL_S = 0.4
_DIRECTIONS = np.array([d for d in product((0.0, 1.0, -1.0), repeat=3) if any(d)])


class Obstacle:
    """A box beside the tool of a robot at home, and how far the arm is from it."""

    def __init__(self, robot: Robot) -> None:
        """Find the nearest place where the box is free.

        Raises:
            ValueError: if there is none.
        """
        home = np.array(robot.profile.home)
        self.kinematics = Kinematics(robot)
        tool = self.kinematics.tool(home)
        for distance in np.arange(_GAP + _HALF, _FARTHEST, 0.02):
            for direction in _DIRECTIONS:
                self.centre = tool + distance * direction
                box = KeepOutBox(kind="box", name=_NAME, centre=tuple(self.centre.tolist()), half=(_HALF,) * 3)
                profile = robot.profile.model_copy(update={"keep_out": [*robot.profile.keep_out, box]})
                self.robot = replace(robot, profile=profile)
                self._scene = CollisionModel(self.robot, self.kinematics)
                self._pairs = [index for index, pair in enumerate(self._scene.pairs) if _NAME in pair]
                if self.clearance(home) > _GAP and self._is_reached():
                    return
        raise ValueError(f"{robot.profile.name}: no room for an obstacle beside the tool")

    def _is_reached(self) -> bool:
        """Return whether the box is reached with tool and joints well inside their limits."""
        home, limits = np.array(self.robot.profile.home), self.robot.limits
        pose, moved = home, 0.0
        while self.clearance(pose) > 0.0 and moved < _FARTHEST_POSE:
            pose = pose + _STEP * self.towards(pose)
            moved = float(np.abs(pose - home).max())
        room = min(float((limits.upper - pose).min()), float((pose - limits.lower).min()))
        if self.clearance(pose) > 0.0 or room < _ROOM or outside(self.robot, self.kinematics, pose) > -_ROOM:
            return False
        # It is to be the arm's links that come near, not the tool point, for which the box is a region (P4, P5).
        return regions(self.robot.profile)[-1].room(self.kinematics.tool(pose)) > 0.5 * _ROOM

    def clearance(self, pose: Vector) -> float:
        """Return the least distance of the arm from the box at a pose (n,), m."""
        return float(self._scene.measure(pose, self._pairs).min())

    def towards(self, position: Vector) -> Vector:
        """Return the joint velocities (n,), the largest 1, that lead the tool to the box."""
        tool, jacobian = self.kinematics.tool_and_jacobian(position)
        push = jacobian.T @ (self.centre - tool)
        return np.asarray(push / max(float(np.abs(push).max()), 1e-9))

    def near(self, clearance: float) -> Vector:
        """Return a pose (n,) on the way to the box with this clearance, m."""
        pose = np.array(self.robot.profile.home)
        while self.clearance(pose) > clearance:
            pose = pose + _STEP * self.towards(pose)
        return pose


@lru_cache(maxsize=4)
def _obstacle(source: str) -> Obstacle:
    return Obstacle(load_robot(source))


def _beside(scenario: Scenario) -> Scenario:
    """Return a scenario with the obstacle beside the arm, which must never come too close to it."""

    def run(robot: Robot, backend: str, seed: int) -> Trial:
        return scenario.run(_obstacle(str(robot.source)).robot, backend, seed)

    return replace(scenario, run=run)


def _approach(bench: Bench) -> Act:
    obstacle = _obstacle(str(bench.robot.source))
    return lambda _time, position: obstacle.towards(position)


def _on_the_way(bench: Bench) -> Vector:
    return _obstacle(str(bench.robot.source)).near(_BEFORE)


def _close_by(bench: Bench) -> None:
    stop = bench.robot.profile.safety.proximity_stop
    bench.place(_obstacle(str(bench.robot.source)).near(stop + _BESIDE))
    still(bench)


def _pulled_in(bench: Bench) -> Planted:
    stop = bench.robot.profile.safety.proximity_stop
    return pulled(bench, _obstacle(str(bench.robot.source)).near(stop - _BESIDE), _PULL_S)


def scenarios(_robot: Robot, _backend: str) -> list[Scenario]:
    near = Expected(
        protection=Protection.PROXIMITY,
        category=Category.BRAKE_HOLD,
        clears=Clears.RETREAT,
        within_s=_PULL_S,
        rest_s=3.0,
        excused=frozenset({"velocity", "keep_out"}),
    )
    return [
        _beside(
            shaped_scenario(
                20,
                "into an obstacle",
                "a policy leads the tool to a box",
                _approach,
                clipped(Clip.PROXIMITY),
                start=_on_the_way,
            )
        ),
        _beside(
            untouchable(stop_scenario(20, "too close", "the arm is pulled towards a box", _pulled_in, near, _close_by))
        ),
    ]
