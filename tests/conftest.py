"""Fixtures that every folder shares."""

import functools

import pytest

from robotctl.hal.robot import Robot, load_robot, robot_names

_load = functools.cache(load_robot)  # robots are immutable


@pytest.fixture(params=robot_names())
def robot(request: pytest.FixtureRequest) -> Robot:
    return _load(request.param)


@pytest.fixture
def panda() -> Robot:
    return _load("panda")
