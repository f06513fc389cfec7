"""The twin's imperfections: lag, delay and noise are what the profile says, and nothing where it says nothing."""

import numpy as np
import pytest

from robotctl.control.session import LockstepSession
from robotctl.hal.backend import open_backend
from robotctl.hal.clock import VirtualClock
from robotctl.hal.errors import ConfigError
from robotctl.hal.robot import load_robot
from robotctl.hal.types import Command, CommandMode

MS = 1_000_000


def step_response(*settings: str) -> np.ndarray:
    """Torque of joint 7, ms by ms, after a step of feed-forward on a held arm."""
    robot = load_robot("panda", list(settings))
    clock = VirtualClock()
    rig = open_backend("sim", robot, clock)
    rig.arm.connect()
    rig.arm.enable()
    rig.arm.hold()
    clock.sleep_until(clock.now_ns() + 200 * MS)
    before = rig.arm.read()
    effort = before.effort.copy()
    effort[6] += 1.0
    rig.arm.write(Command(CommandMode.EFFORT, before.position, np.zeros(7), effort))
    torques = []
    for _ in range(100):
        clock.sleep_until(clock.now_ns() + MS)
        torques.append(rig.arm.read().effort[6] - before.effort[6])
    return np.array(torques)


def test_without_imperfections_a_command_acts_at_once() -> None:
    assert step_response()[1] == pytest.approx(1.0, abs=0.01)


def test_a_delay_is_dead_time() -> None:
    response = step_response("twin.delay_s=0.02")
    assert np.abs(response[:19]).max() < 0.01
    assert response[22] == pytest.approx(1.0, abs=0.01)


def test_noise_has_the_spread_of_the_profile() -> None:
    robot = load_robot("panda", ["twin.noise_position=0.001", "twin.noise_velocity=0.02"])
    rig = open_backend("sim", robot, VirtualClock())
    rig.arm.connect()
    samples = [rig.arm.read() for _ in range(2000)]
    assert np.std([sample.position for sample in samples], axis=0) == pytest.approx(np.full(7, 1e-3), rel=0.1)
    assert np.std([sample.velocity for sample in samples], axis=0) == pytest.approx(np.full(7, 0.02), rel=0.1)
    assert rig.arm.truth() is not None
    np.testing.assert_array_equal(rig.arm.truth().position, rig.arm.truth().position)


@pytest.mark.parametrize("setting", ["twin.lag_s=0.02", "twin.delay_s=0.01", "twin.payload=0.3"])
def test_the_loop_goes_home_whatever_the_imperfection(setting: str) -> None:
    robot = load_robot("panda", [setting])
    with LockstepSession(robot, "sim") as session:
        session.prepare()
        session.advance(4.0)
        true = session.latest()["true_position"]
        assert np.abs(true - robot.profile.home).max() < 5e-3
        session.finish()
        assert session.trips == []


def test_lag_slows_a_command_by_its_time_constant() -> None:
    """Also across the change from tracking to torque: gains change at once, the torque does not jump."""
    response = step_response("twin.lag_s=0.02")
    assert response[19] == pytest.approx(1.0 - np.exp(-1.0), abs=0.06)
    assert response[99] == pytest.approx(1.0, abs=0.02)
    assert response.max() < 1.05
    assert response.min() > -0.05


def test_a_channel_is_refused() -> None:
    with pytest.raises(ConfigError, match="no channel"):
        open_backend("sim", load_robot("panda"), VirtualClock(), "can0")
