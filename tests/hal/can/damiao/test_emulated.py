"""The arm against the emulated drives: the whole life, and the troubles of a real bench."""

import warnings

import numpy as np
import pytest

from robotctl.hal.backend import open_backend
from robotctl.hal.can.damiao.registers import Register
from robotctl.hal.clock import VirtualClock
from robotctl.hal.errors import DriveError, HardwareError
from robotctl.hal.robot import load_robot
from robotctl.hal.types import Command, CommandMode
from robotctl.sim.motors.trouble import Corrupt, Delay, Drop, Duplicate, Failure, Mute, PowerCut


class Rehearsal:
    def __init__(self, name):
        self.robot = load_robot(name)
        self.clock = VirtualClock(1_000_000_000)
        rig = open_backend("can", self.robot, self.clock)
        self.arm, self.gripper = rig.arm, rig.gripper
        self.arm.connect()
        self.bench = self.arm._channel.bus.bench
        self.home = np.array(self.robot.profile.home)

    def tick(self, count=1):
        zero = np.zeros(self.robot.dof)
        for _ in range(count):
            self.clock.sleep_until(self.clock.now_ns() + self.robot.period_ns)
            sample = self.arm.read()
            self.arm.write(Command(CommandMode.TRACK, self.home, zero, zero))
            self.gripper.step()
        return sample

    def start(self):
        self.arm.verify()
        self.arm.enable()


@pytest.fixture(params=["panda", "openarm"])
def rehearsal(request):
    made = Rehearsal(request.param)
    yield made
    made.arm.close()


def test_a_life(rehearsal):
    rehearsal.start()
    sample = rehearsal.tick(200)
    assert sample.enabled
    assert sample.faults == ()
    assert sample.position == pytest.approx(rehearsal.arm.truth().position, abs=0.01)
    rehearsal.arm.disable()
    assert not any(drive.enabled for drive in rehearsal.bench.drives)
    statistics = rehearsal.arm.bus_statistics()
    assert statistics["missed_replies"] == 0
    assert statistics["unexpected"] == 0


def test_verifying_moves_nothing_and_enables_nothing(rehearsal):
    before = rehearsal.bench.plant.truth().position
    rehearsal.arm.verify()
    assert not any(drive.enabled for drive in rehearsal.bench.drives)
    if rehearsal.robot.profile.brakes:
        assert rehearsal.arm.truth().position == pytest.approx(before, abs=5e-3)


def test_samples_are_stamped_with_the_reply_and_not_with_the_reading(rehearsal):
    rehearsal.start()
    rehearsal.tick(3)
    written = rehearsal.clock.now_ns()
    rehearsal.clock.sleep_until(written + rehearsal.robot.period_ns)
    assert (rehearsal.arm.read().joint_stamp_ns == written).all()


def test_silence_trips_the_watchdogs_and_recovery_takes_three_steps(rehearsal):
    rehearsal.start()
    rehearsal.clock.sleep_until(rehearsal.clock.now_ns() + 200_000_000)
    sample = rehearsal.tick(2)
    assert {fault.name for fault in sample.faults} == {"COMMUNICATION_LOST"}
    assert not sample.enabled
    rehearsal.arm.disable()
    with pytest.raises(HardwareError, match="COMMUNICATION_LOST"):
        rehearsal.arm.enable()
    rehearsal.arm.clear_faults()
    assert not any(drive.enabled for drive in rehearsal.bench.drives)
    rehearsal.arm.enable()
    assert rehearsal.tick(2).enabled


def test_waiting_while_disabled_keeps_the_feedback_fresh(rehearsal):
    rehearsal.arm.verify()
    for _ in range(100):
        rehearsal.clock.sleep_until(rehearsal.clock.now_ns() + rehearsal.robot.period_ns)
        sample = rehearsal.arm.read()
        assert (sample.stamp_ns - sample.joint_stamp_ns).max() < 10_000_000


def test_bring_up_survives_a_poor_line(rehearsal):
    rehearsal.bench.trouble.add(Drop(probability=0.1))
    rehearsal.start()
    sample = rehearsal.tick(100)
    assert sample.enabled
    assert rehearsal.arm.bus_statistics()["missed_replies"] > 50
    rehearsal.arm.disable()
    assert not any(drive.enabled for drive in rehearsal.bench.drives)


@pytest.mark.parametrize("trouble", [Corrupt(probability=0.5), Delay(delay_s=0.003, jitter_s=0.004), Duplicate()])
def test_trouble_on_the_wire_never_raises_in_the_loop(rehearsal, trouble):
    rehearsal.start()
    rehearsal.bench.trouble.add(trouble)
    rehearsal.tick(200)


def test_a_mute_drive_grows_old(rehearsal):
    rehearsal.start()
    rehearsal.tick(5)
    rehearsal.bench.trouble.add(Mute(motor_id=2))
    sample = rehearsal.tick(10)
    age = sample.stamp_ns - sample.joint_stamp_ns
    assert age[1] >= 9 * rehearsal.robot.period_ns
    assert np.delete(age, 1).max() <= rehearsal.robot.period_ns


def test_a_drive_that_loses_its_power(rehearsal):
    rehearsal.start()
    rehearsal.bench.trouble.add(PowerCut(motor_id=3))
    rehearsal.tick(5)
    with pytest.raises(DriveError, match=r"motor id 0x03.*did not confirm"):
        rehearsal.arm.disable()
    others = [drive for drive in rehearsal.bench.drives if drive.id != 3]
    assert not any(drive.enabled for drive in others)


def test_a_failing_drive_is_a_fault(rehearsal):
    rehearsal.start()
    rehearsal.bench.trouble.add(Failure(motor_id=4))
    (fault,) = rehearsal.tick(3).faults
    assert fault.name == "OVER_CURRENT"
    assert fault.joint == rehearsal.robot.profile.joints[3].name


def test_a_failing_gripper_drive_is_a_fault_of_the_gripper(rehearsal):
    rehearsal.start()
    rehearsal.bench.trouble.add(Failure(motor_id=8))
    sample = rehearsal.tick(10)
    assert [fault.joint for fault in sample.faults] == ["gripper"]
    assert sample.enabled


def test_a_drive_without_watchdog_is_refused(rehearsal):
    rehearsal.arm._drives[0].write_register(Register.TIMEOUT, 0)
    with pytest.raises(DriveError, match="no watchdog"):
        rehearsal.arm.verify()


def test_the_gripper_opens_and_closes(rehearsal):
    rehearsal.start()
    for width in (0.06, 0.02):
        rehearsal.gripper.command(width, 20.0)
        rehearsal.tick(500)
        assert rehearsal.gripper.read().width == pytest.approx(width, abs=0.003)


def test_nothing_is_left_open():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        rehearsal = Rehearsal("panda")
        rehearsal.start()
        rehearsal.arm.disable()
        rehearsal.arm.close()
        rehearsal.arm.connect()
        rehearsal.arm.verify()
        rehearsal.arm.close()
