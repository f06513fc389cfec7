"""Poses at the edge of what is allowed."""

import numpy as np

from robotctl.control.kinematics import Kinematics
from robotctl.hal.robot import Robot
from robotctl.hal.types import Vector

_ATTEMPTS = 200
_STEP = 1e-3
_CLOSE = 0.04


def outside(robot: Robot, kinematics: Kinematics, pose: Vector) -> float:
    """Return how far the tool is outside its sphere at a pose (n,), m; negative inside."""
    sphere = robot.profile.sphere
    return float(np.linalg.norm(kinematics.tool(pose) - np.array(sphere.centre))) - sphere.radius


def at_limit(robot: Robot, rng: np.random.Generator, inside: float) -> tuple[Vector, int, float]:
    """Return a pose with one joint this far inside a soft limit, rad; the joint; and its direction outward, +-1.

    The rest of the arm is at home, the tool well inside its sphere.
    """
    kinematics = Kinematics(robot)
    for _ in range(_ATTEMPTS):
        pose = np.array(robot.profile.home)
        joint, up = int(rng.integers(robot.dof)), bool(rng.integers(2))
        pose[joint] = robot.limits.upper[joint] - inside if up else robot.limits.lower[joint] + inside
        if outside(robot, kinematics, pose) < -0.05:
            return pose, joint, 1.0 if up else -1.0
    raise ValueError(f"{robot.profile.name}: no joint reaches a limit with the tool inside its sphere")


def at_sphere(robot: Robot, rng: np.random.Generator, distances: tuple[float, float]) -> tuple[Vector, Vector]:
    """Return two poses close to each other, with the tool these distances outside its sphere, m, joints inside limits.

    The distances grow from the first to the second; negative is inside.
    """
    kinematics = Kinematics(robot)
    centre = np.array(robot.profile.sphere.centre)
    margin = 0.05
    for _ in range(_ATTEMPTS):
        pose = np.clip(
            np.array(robot.profile.home) + rng.uniform(-0.5, 0.5, robot.dof),
            robot.limits.lower + margin,
            robot.limits.upper - margin,
        )
        found = []
        for distance in distances:
            for _ in range(3000):
                if outside(robot, kinematics, pose) >= distance:
                    found.append(pose)
                    break
                tool, jacobian = kinematics.tool_and_jacobian(pose)
                ascent = jacobian.T @ (tool - centre)
                step = _STEP * ascent / max(float(np.linalg.norm(ascent)), 1e-9)
                pose = np.clip(pose + step, robot.limits.lower + margin, robot.limits.upper - margin)
        if len(found) == 2 and np.abs(found[1] - found[0]).max() < _CLOSE:
            return found[0], found[1]
    raise ValueError(f"{robot.profile.name}: the tool does not reach its sphere")
