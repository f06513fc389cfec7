"""Fixtures that every folder shares."""

import pytest

from robotctl.hal.robot import Robot, load_robot, robot_names


@pytest.fixture(params=robot_names())
def robot(request: pytest.FixtureRequest) -> Robot:
    return load_robot(request.param)


@pytest.fixture(scope="session")
def panda() -> Robot:
    return load_robot("panda")
