"""The safety contract, for every robot on every backend that can carry it."""

import pytest

from robotctl.hal.robot import Robot, load_robot, robot_names

from .safety_contract import SafetyContract

WITH_DRIVES = [name for name in robot_names() if load_robot(name).profile.can]


class TestSim(SafetyContract):
    backend = "sim"

    @pytest.fixture(params=robot_names())
    def robot(self, request: pytest.FixtureRequest) -> Robot:
        return load_robot(request.param)


class TestCan(SafetyContract):
    backend = "can"

    @pytest.fixture(params=WITH_DRIVES)
    def robot(self, request: pytest.FixtureRequest) -> Robot:
        return load_robot(request.param)
