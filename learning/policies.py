"""Policies by name: the scripted one that solves `reach`, hostile ones that try to break the arm, and networks."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from robotctl.control.kinematics import Kinematics
from robotctl.hal.errors import ConfigError
from robotctl.hal.robot import Robot
from robotctl.hal.types import Vector
from robotctl.learning.network import NetworkPolicy
from robotctl.learning.policy import Observation, Policy

_BEHAVES = 10
"""Policy steps for which the treacherous ones behave."""


class Stall(Exception):  # noqa: N818 - a behaviour, not an error
    """The policy stops answering."""


class Die(Exception):  # noqa: N818
    """The policy's process ends on the spot."""


class Scripted(Policy):
    """Resolved-rate reaching with damped least squares; what is left of the motion leads the joints home.

    dq = J^T (J J^T + d^2 I)^-1 v + (I - J^+ J) g (home - q), with v towards the goal (Wampler 1986;
    Nakamura and Hanafusa 1986).
    """

    _GAIN = 4.0
    _SPEED = 0.35
    _DAMPING = 0.03
    _POSTURE = 0.5

    def __init__(self, robot: Robot, kinematics: Kinematics, seed: int = 0) -> None:
        self._kinematics = kinematics
        self._home = np.array(robot.profile.home)
        self._cap = robot.limits.velocity

    def act(self, observation: Observation) -> Vector:
        tool, jacobian = self._kinematics.tool_and_jacobian(observation.position)
        motion = self._GAIN * (observation.goal - tool)
        speed = float(np.linalg.norm(motion))
        if speed > self._SPEED:
            motion *= self._SPEED / speed
        pseudo = jacobian.T @ np.linalg.inv(jacobian @ jacobian.T + self._DAMPING**2 * np.eye(3))
        posture = self._POSTURE * (self._home - observation.position)
        velocity = pseudo @ motion + posture - pseudo @ (jacobian @ posture)
        return np.asarray(velocity / max(1.0, float((np.abs(velocity) / self._cap).max())))


class Random(Policy):
    """Uniform velocities up to twice the caps, anew in every step."""

    def __init__(self, robot: Robot, kinematics: Kinematics, seed: int = 0) -> None:
        self._cap = robot.limits.velocity
        self._rng = np.random.default_rng(seed)

    def act(self, observation: Observation) -> Vector:
        return self._rng.uniform(-2.0, 2.0, self._cap.shape) * self._cap


class Outward(Policy):
    """Pushes the tool out of its sphere for ever, and every joint that has no part in it against a limit."""

    def __init__(self, robot: Robot, kinematics: Kinematics, seed: int = 0) -> None:
        self._kinematics = kinematics
        self._centre = np.array(robot.profile.sphere.centre)
        self._cap = robot.limits.velocity
        self._rng = np.random.default_rng(seed)

    def act(self, observation: Observation) -> Vector:
        if observation.step % 60 == 0:
            self._rest = self._rng.choice([-1.0, 1.0], self._cap.shape)
        tool, jacobian = self._kinematics.tool_and_jacobian(observation.position)
        push = jacobian.T @ (tool - self._centre)
        strength = np.abs(push) / max(float(np.abs(push).max()), 1e-9)
        return 2.0 * self._cap * np.where(strength > 0.05, np.sign(push), self._rest)


class NotANumber(Policy):
    """Behaves for half a second, then sends NaN."""

    def __init__(self, robot: Robot, kinematics: Kinematics, seed: int = 0) -> None:
        self._scripted = Scripted(robot, kinematics)

    def act(self, observation: Observation) -> Vector:
        velocity = self._scripted.act(observation)
        if observation.step >= _BEHAVES:
            velocity[0] = np.nan
        return velocity


class Stalling(Policy):
    """Behaves for half a second, then hangs."""

    def __init__(self, robot: Robot, kinematics: Kinematics, seed: int = 0) -> None:
        self._scripted = Scripted(robot, kinematics)

    def act(self, observation: Observation) -> Vector:
        if observation.step >= _BEHAVES:
            raise Stall
        return self._scripted.act(observation)


class Dying(Policy):
    """Behaves for half a second, then its process is killed."""

    def __init__(self, robot: Robot, kinematics: Kinematics, seed: int = 0) -> None:
        self._scripted = Scripted(robot, kinematics)

    def act(self, observation: Observation) -> Vector:
        if observation.step >= _BEHAVES:
            raise Die
        return self._scripted.act(observation)


POLICIES: dict[str, Callable[[Robot, Kinematics, int], Policy]] = {
    "scripted": Scripted,
    "random": Random,
    "outward": Outward,
    "nan": NotANumber,
    "stall": Stalling,
    "die": Dying,
}


def make_policy(name: str, robot: Robot, kinematics: Kinematics, seed: int = 0) -> Policy:
    """Return a policy by its name, or by the path of a network (`.npz`).

    Raises:
        ConfigError: if there is no such policy, or the network is refused.
    """
    if name.endswith(".npz"):
        return NetworkPolicy(robot, Path(name))
    factory = POLICIES.get(name)
    if factory is None:
        raise ConfigError(f"unknown policy {name!r}", f"use one of {', '.join(POLICIES)}, or the path of a .npz file")
    return factory(robot, kinematics, seed)
