"""The twin's imperfections: lag, delay and noise are what the profile says, and nothing where it says nothing."""

import numpy as np
import pytest

from robotctl.control.session import LockstepSession
from robotctl.hal.backend import open_backend
from robotctl.hal.clock import VirtualClock
from robotctl.hal.errors import ConfigError, HardwareError
from robotctl.hal.robot import load_robot
from robotctl.hal.types import Command, CommandMode, Sample

MS = 1_000_000


def step_response(*settings: str) -> np.ndarray:
    """Torque of joint 7, ms by ms, after a step of feed-forward on a held arm."""
    robot = load_robot("panda", list(settings))
    clock = VirtualClock()
    rig = open_backend("sim", robot, clock)
    rig.arm.connect()
    rig.arm.enable()
    for _ in range(4):
        rig.arm.hold()
        clock.sleep_until(clock.now_ns() + 50 * MS)
        rig.arm.read()
    before = rig.arm.read()
    effort = before.effort.copy()
    effort[6] += 1.0
    rig.arm.write(Command(CommandMode.EFFORT, before.position, np.zeros(7), effort))
    torques = []
    for _ in range(79):  # then the drives' watchdog bites
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
    assert response[78] == pytest.approx(1.0, abs=0.03)
    assert response.max() < 1.05
    assert response.min() > -0.05


def test_a_channel_is_refused() -> None:
    with pytest.raises(ConfigError, match="no channel"):
        open_backend("sim", load_robot("panda"), VirtualClock(), "can0")


class Twin:
    """An enabled twin that holds its home pose."""

    def __init__(self, name: str = "panda", *settings: str) -> None:
        self.robot = load_robot(name, list(settings))
        self.clock = VirtualClock(1_000_000_000)
        self.arm = open_backend("sim", self.robot, self.clock).arm
        self.arm.connect()
        self.arm.enable()

    def pass_ms(self, ms: int, *, feeding: bool = False) -> Sample:
        for _ in range(ms):
            self.clock.sleep_until(self.clock.now_ns() + MS)
            sample = self.arm.read()
            if feeding:
                self.arm.hold()
        return sample


def test_drives_that_are_fed_stay_on() -> None:
    twin = Twin()
    for _ in range(5):
        assert twin.pass_ms(79).enabled
        twin.arm.hold()


@pytest.mark.parametrize("jump", [False, True])
@pytest.mark.parametrize("delay", ["0.0", "0.01"])
def test_drives_without_commands_go_off_by_themselves(jump: bool, delay: str) -> None:
    twin = Twin("panda", f"twin.delay_s={delay}")
    twin.pass_ms(10, feeding=True)
    assert twin.pass_ms(79).enabled
    if jump:
        twin.clock.sleep_until(twin.clock.now_ns() + 500 * MS)
        sample = twin.arm.read()
    else:
        sample = twin.pass_ms(1)
    assert not sample.enabled
    assert [(fault.joint, fault.name) for fault in sample.faults] == [
        (joint.name, "COMMUNICATION_LOST") for joint in twin.robot.profile.joints
    ]
    twin.arm.hold()
    twin.pass_ms(1)
    assert not twin.arm.truth().effort.any()


def test_the_watchdog_bites_in_its_own_time_however_late_it_is_looked_at() -> None:
    """An arm without brakes falls from the moment on at which its drives went off, not from the next look."""
    falls = []
    for steps in ([500], [80, 420], [20] * 25):
        twin = Twin("openarm")
        for ms in steps:
            twin.clock.sleep_until(twin.clock.now_ns() + ms * MS)
            twin.arm.read()
        falls.append(twin.arm.truth().position)
    assert np.abs(falls[0] - load_robot("openarm").profile.rest).max() > 0.01
    np.testing.assert_allclose(falls[1], falls[0], atol=1e-9)
    np.testing.assert_allclose(falls[2], falls[0], atol=1e-9)


def test_a_fault_of_the_watchdog_is_refused_until_cleared_and_clearing_enables_nothing() -> None:
    twin = Twin()
    twin.pass_ms(100)
    for call in (twin.arm.verify, twin.arm.enable):
        with pytest.raises(HardwareError, match="panda_joint1 reports COMMUNICATION_LOST"):
            call()
    twin.arm.clear_faults()
    twin.arm.hold()
    sample = twin.pass_ms(1)
    assert sample.faults == ()
    assert not sample.enabled
    twin.arm.disable()
    twin.arm.enable()
    assert twin.pass_ms(50).enabled


def test_a_drive_that_fails_leaves_the_others_at_work() -> None:
    twin = Twin("openarm")
    twin.pass_ms(50, feeding=True)
    twin.arm.fail([3], 0xA, "OVER_CURRENT", "a test")
    sample = twin.pass_ms(50, feeding=True)
    assert [(fault.joint, fault.code) for fault in sample.faults] == [("openarm_right_joint4", 0xA)]
    assert not sample.enabled
    effort = twin.arm.truth().effort
    assert [joint for joint, torque in enumerate(effort) if torque == 0.0] == [3]


def test_drives_without_power_have_no_torque_and_do_not_enable() -> None:
    twin = Twin()
    twin.arm.power_down([2])
    sample = twin.pass_ms(10, feeding=True)
    assert sample.faults == ()
    assert sample.enabled
    assert twin.arm.truth().effort[2] == 0.0
    twin.arm.disable()
    with pytest.raises(HardwareError, match="panda_joint3"):
        twin.arm.enable()
    twin.arm.power_up([2])
    twin.arm.enable()
    assert twin.pass_ms(10).enabled


def test_drives_warm_up_with_their_load() -> None:
    twin = Twin()
    assert twin.arm.read().temperature == pytest.approx(25.0)
    first = twin.pass_ms(2000, feeding=True).temperature
    assert first[1] > 25.02
    assert first[1] > first[0]
