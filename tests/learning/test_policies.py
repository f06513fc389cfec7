"""The policies: the one that reaches, and those that misbehave."""

import numpy as np
import pytest

from robotctl.control.kinematics import Kinematics
from robotctl.hal.errors import ConfigError
from robotctl.hal.robot import Robot
from robotctl.learning.policies import POLICIES, Die, Stall, make_policy
from robotctl.learning.policy import Observation


@pytest.fixture
def kinematics(robot: Robot) -> Kinematics:
    return Kinematics(robot)


def observation(robot, kinematics, goal, step=0, position=None):
    position = np.array(robot.profile.home) if position is None else position
    return Observation(position, np.zeros(robot.dof), kinematics.tool(position), goal, step)


def test_scripted_brings_the_tool_to_its_goal(robot: Robot, kinematics: Kinematics):
    policy = make_policy("scripted", robot, kinematics)
    position = np.array(robot.profile.home)
    goal = kinematics.tool(position) + np.array([-0.05, 0.05, -0.05])
    distances = []
    for step in range(100):
        velocity = policy.act(observation(robot, kinematics, goal, step, position))
        assert velocity.shape == (robot.dof,)
        assert velocity.dtype == np.float64
        assert (np.abs(velocity) <= robot.limits.velocity * (1 + 1e-9)).all()
        position = position + 0.05 * velocity
        distances.append(np.linalg.norm(kinematics.tool(position) - goal))
    assert distances[-1] < 2e-3
    assert distances[-1] < 0.05 * distances[0]


def test_scripted_limits_the_tools_speed(robot: Robot, kinematics: Kinematics):
    policy = make_policy("scripted", robot, kinematics)
    home = np.array(robot.profile.home)
    far = kinematics.tool(home) + np.array([0.0, 0.0, -1.0])
    velocity = policy.act(observation(robot, kinematics, far))
    _, jacobian = kinematics.tool_and_jacobian(home)
    assert np.linalg.norm(jacobian @ velocity) <= 0.35 + 1e-6


def test_random_goes_up_to_twice_the_caps_and_follows_its_seed(robot: Robot, kinematics: Kinematics):
    seen = observation(robot, kinematics, np.zeros(3))
    runs = []
    for seed in (1, 1, 2):
        policy = make_policy("random", robot, kinematics, seed)
        runs.append(np.array([policy.act(seen) for _ in range(300)]))
    assert np.array_equal(runs[0], runs[1])
    assert not np.array_equal(runs[0], runs[2])
    ratio = np.abs(runs[0]) / robot.limits.velocity
    assert ratio.max() <= 2.0
    assert (ratio.max(axis=0) > 1.8).all()


def test_outward_pushes_the_tool_out_of_its_sphere(robot: Robot, kinematics: Kinematics):
    policy = make_policy("outward", robot, kinematics, 3)
    centre = np.array(robot.profile.sphere.centre)
    rng = np.random.default_rng(1)
    for step in range(50):
        position = rng.uniform(robot.limits.lower, robot.limits.upper)
        seen = observation(robot, kinematics, np.zeros(3), step, position)
        velocity = policy.act(seen)
        assert np.abs(velocity) == pytest.approx(2.0 * robot.limits.velocity)
        tool, jacobian = kinematics.tool_and_jacobian(position)
        push = jacobian.T @ (tool - centre)
        if np.abs(push).max() > 0.05:
            assert push @ velocity > 0.0


@pytest.mark.parametrize("name", ["nan", "stall", "die"])
def test_the_treacherous_ones_behave_for_half_a_second(robot: Robot, kinematics: Kinematics, name: str):
    policy, scripted = (make_policy(key, robot, kinematics) for key in (name, "scripted"))
    goal = kinematics.tool(np.array(robot.profile.home)) + 0.05
    for step in range(10):
        seen = observation(robot, kinematics, goal, step)
        assert policy.act(seen) == pytest.approx(scripted.act(seen))
    for step in (10, 11, 100):
        seen = observation(robot, kinematics, goal, step)
        if name == "nan":
            assert np.isnan(policy.act(seen)).any()
        else:
            with pytest.raises(Stall if name == "stall" else Die):
                policy.act(seen)


def test_an_unknown_policy_is_refused_with_those_there_are(panda: Robot):
    with pytest.raises(ConfigError, match="unknown policy 'clever'") as caught:
        make_policy("clever", panda, Kinematics(panda))
    for name in POLICIES:
        assert name in str(caught.value)
