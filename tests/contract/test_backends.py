"""The contract, for every robot on every backend that can carry it."""

import pytest

from robotctl.hal.backend import Rig, open_backend
from robotctl.hal.clock import VirtualClock
from robotctl.hal.errors import ConfigError
from robotctl.hal.robot import Robot, load_robot, robot_names
from robotctl.sim.plant import Plant

from .arm_contract import ArmContract, GripperContract

ALL = robot_names()
WITH_DRIVES = [name for name in ALL if load_robot(name).profile.can]
WITH_GRIPPER = [name for name in ALL if load_robot(name).profile.gripper]


class Sim:
    def open(self, robot: Robot, clock: VirtualClock) -> Rig:
        return open_backend("sim", robot, clock)

    def plant(self, rig: Rig) -> Plant:
        return rig.arm._plant


class Can:
    verified_first = True

    def open(self, robot: Robot, clock: VirtualClock) -> Rig:
        return open_backend("can", robot, clock, "emulated")

    def plant(self, rig: Rig) -> Plant:
        return rig.arm.channel.bus.bench.plant


class TestSimArm(Sim, ArmContract):
    @pytest.fixture(params=ALL)
    def robot(self, request: pytest.FixtureRequest) -> Robot:
        return load_robot(request.param)


class TestCanArm(Can, ArmContract):
    @pytest.fixture(params=WITH_DRIVES)
    def robot(self, request: pytest.FixtureRequest) -> Robot:
        return load_robot(request.param)


class TestSimGripper(Sim, GripperContract):
    @pytest.fixture(params=WITH_GRIPPER)
    def robot(self, request: pytest.FixtureRequest) -> Robot:
        return load_robot(request.param)


class TestCanGripper(Can, GripperContract):
    @pytest.fixture(params=[name for name in WITH_GRIPPER if name in WITH_DRIVES])
    def robot(self, request: pytest.FixtureRequest) -> Robot:
        return load_robot(request.param)


def test_nothing_is_left_out():
    assert ALL == ["kinova", "openarm", "openarm_bimanual", "panda", "xarm7"]
    assert WITH_DRIVES == ["openarm", "openarm_bimanual", "panda", "xarm7"]
    assert WITH_GRIPPER == ["openarm", "openarm_bimanual", "panda"]


def test_robots_and_backends_that_do_not_go_together_are_refused():
    clock = VirtualClock()
    with pytest.raises(ConfigError, match="`can` section"):
        open_backend("can", load_robot("kinova"), clock)
    with pytest.raises(ConfigError, match="no channel"):
        open_backend("sim", load_robot("panda"), clock, "socketcan:can0")
    with pytest.raises(ConfigError, match=r"unknown backend 'ros'\n  try: use one of can, sim"):
        open_backend("ros", load_robot("panda"), clock)
