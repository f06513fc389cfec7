"""Policies of the trials: one that swings the arm about, and hostile ones. All are seeded.

A policy of this module answers with an action (n,) in -1..1, which `velocities` and `torques` turn into targets.
"""

from collections.abc import Callable

import numpy as np

from robotctl.control.kinematics import Kinematics
from robotctl.hal.robot import Robot
from robotctl.hal.types import Vector
from robotctl.safety.target import JointTorque, JointVelocity, Target
from robotctl.trials.bench import Bench, Policy
from robotctl.trials.poses import at_limit

Act = Callable[[float, Vector], Vector]
"""Takes the time, s, and the measured joints (n,), rad; returns an action (n,)."""

EXCESS = 2.0
"""Multiple of the velocity caps that a hostile action of 1 asks for."""
_RUN_UP = 0.4
"""rad"""
_TORQUE_SHARE = 0.6
"""Part of the torque caps that an action of 1 asks for, on top of gravity."""


def velocities(act: Act, scale: float = EXCESS) -> Policy:
    """Return the policy that asks for joint velocities: an action of 1 is `scale` times the cap."""

    def policy(bench: Bench, time: float) -> Target:
        action = act(time, bench.position)
        return JointVelocity(scale * action * bench.robot.limits.velocity, *bench.stamp())

    return policy


def torques(act: Act, scale: float = _TORQUE_SHARE) -> Policy:
    """Return the policy that asks for joint torques: an action of 1 is `scale` times the cap."""

    def policy(bench: Bench, time: float) -> Target:
        action = act(time, bench.position)
        return JointTorque(scale * action * bench.robot.limits.torque, *bench.stamp())

    return policy


def sway(bench: Bench, share: float = 1.0) -> Policy:
    """Swing every joint at up to a share of its cap, once in two seconds, each with a phase of its own."""
    phase = bench.random.uniform(0.0, 2.0 * np.pi, bench.robot.dof)
    return velocities(lambda time, _: np.sin(np.pi * time + phase), share)


def random(robot: Robot, rng: np.random.Generator) -> Act:
    """Something else in every step."""
    return lambda _time, _position: rng.uniform(-1.0, 1.0, robot.dof)


def bang_bang(robot: Robot, rng: np.random.Generator) -> Act:
    """Full action in every joint, changing sign at random moments of its own."""
    sign = rng.choice([-1.0, 1.0], robot.dof)
    chance = rng.uniform(0.02, 0.3, robot.dof)

    def act(_time: float, _position: Vector) -> Vector:
        sign[rng.random(robot.dof) < chance] *= -1.0
        return sign.copy()

    return act


def outward(robot: Robot, rng: np.random.Generator) -> Act:
    """The tool out of its sphere for ever, and every joint that has no part in it against a limit."""
    kinematics = Kinematics(robot)
    centre = np.array(robot.profile.sphere.centre)
    rest = rng.choice([-1.0, 1.0], robot.dof)
    patience = rng.uniform(2.0, 4.0)
    changes = patience

    def act(time: float, position: Vector) -> Vector:
        nonlocal rest, changes
        if time > changes:
            rest, changes = rng.choice([-1.0, 1.0], robot.dof), time + patience
        tool, jacobian = kinematics.tool_and_jacobian(position)
        push = jacobian.T @ (tool - centre)
        strength = np.abs(push) / max(float(np.abs(push).max()), 1e-9)
        return np.where(strength > 0.05, np.sign(push), rest)

    return act


def before_limit(bench: Bench) -> Vector:
    """Return a pose (n,) from which a joint gets up speed before it comes to a soft limit; the seed says which."""
    return at_limit(bench.robot, np.random.default_rng(bench.seed), _RUN_UP)[0]


def against_limit(bench: Bench) -> Act:
    """The joint of `before_limit` against its limit for ever, and all others somewhere."""
    _, joint, outward = at_limit(bench.robot, np.random.default_rng(bench.seed), _RUN_UP)
    sign = bench.random.choice([-1.0, 1.0], bench.robot.dof)
    sign[joint] = outward
    return lambda _time, _position: sign
