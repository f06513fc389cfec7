"""Fixtures that every folder shares."""

import functools
from collections.abc import Callable

import numpy as np
import pytest

from robotctl.control.kinematics import Kinematics
from robotctl.hal.robot import Robot, load_robot, robot_names

_load = functools.cache(load_robot)  # robots are immutable


@pytest.fixture(params=robot_names())
def robot(request: pytest.FixtureRequest) -> Robot:
    return _load(request.param)


@pytest.fixture
def panda() -> Robot:
    return _load("panda")


@pytest.fixture
def keep_outs() -> Callable[[Robot], str]:
    """The setting for a table under home, and a turned box beside it."""

    def setting(robot: Robot) -> str:
        home = Kinematics(robot).tool(np.array(robot.profile.home))
        box = [round(float(value), 4) for value in home + np.array([0.02, 0.13, 0.0])]
        table = f"{{kind: plane, name: table, point: [0, 0, {home[2] - 0.06:.4f}], normal: [0, 0, 1]}}"
        post = f"{{kind: box, name: post, centre: {box}, half: [0.05, 0.06, 0.2], rpy: [0.2, 0, 0.7], clearance: 0.01}}"
        return f"keep_out=[{table}, {post}]"

    return setting
