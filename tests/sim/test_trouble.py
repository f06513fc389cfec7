"""Trouble round the twin: each does what it says, and nothing else."""

import numpy as np
import pytest

from robotctl.hal.backend import open_backend
from robotctl.hal.clock import VirtualClock
from robotctl.hal.errors import DriveError
from robotctl.hal.robot import load_robot
from robotctl.hal.types import Command, CommandMode, Fault
from robotctl.sim.trouble import (
    Garble,
    Heat,
    Misread,
    Mute,
    NoWatchdog,
    Reject,
    Report,
    Runaway,
    Trouble,
    TroubledArm,
    Weak,
)

ROBOT = load_robot("panda")
HOME = np.array(ROBOT.profile.home)
REST = np.zeros(7)


class Desk:
    """A troubled twin that holds its home pose."""

    def __init__(self) -> None:
        self.clock = VirtualClock(1_000_000_000)
        self.arm = TroubledArm(open_backend("sim", ROBOT, self.clock).arm)
        self.twin = self.arm.arm
        self.arm.connect()
        self.arm.verify()
        self.arm.enable()
        self.gravity = self.twin.plant.data.qfrc_bias[:7].copy()
        self.tick(5)

    def tick(self, count: int = 1, mode: CommandMode = CommandMode.TRACK, velocity=REST, position=HOME):
        for _ in range(count):
            self.clock.sleep_until(self.clock.now_ns() + ROBOT.period_ns)
            sample = self.arm.read()
            self.arm.write(Command(mode, position, velocity, self.gravity))
        return sample

    def plant(self, trouble: Trouble) -> Trouble:
        self.arm.troubles.append(trouble)
        return trouble


@pytest.fixture
def desk() -> Desk:
    return Desk()


def test_without_trouble_it_is_the_arm_it_wraps(desk: Desk) -> None:
    sample, inner = desk.arm.read(), desk.twin.read()
    for one, other in zip(sample, inner, strict=True):
        assert np.array_equal(one, other)
    assert desk.arm.truth() is desk.twin.truth()
    assert desk.arm.bus_statistics() is None
    desk.arm.disable()
    assert not desk.twin.enabled


def test_mute_joints_stay_what_they_were_and_grow_old(desk: Desk) -> None:
    before = desk.arm.seen
    trouble = desk.plant(Mute([2, 5], before))
    sample = desk.tick(20, velocity=np.full(7, 0.1), position=HOME + 0.02)
    age = sample.stamp_ns - sample.joint_stamp_ns
    assert (age[[2, 5]] == 20 * ROBOT.period_ns).all()
    assert (np.delete(age, [2, 5]) == 0).all()
    assert (sample.position[[2, 5]] == before.position[[2, 5]]).all()
    assert (np.delete(sample.position - before.position, [2, 5]) != 0.0).all()
    assert trouble.acted == 20
    assert (before.joint_stamp_ns == before.stamp_ns).all()


def test_misread_adds_to_what_is_measured(desk: Desk) -> None:
    desk.plant(Misread(position=np.arange(7) * 0.1, velocity=0.2))
    sample, true = desk.tick(), desk.twin.truth()
    assert sample.position - true.position == pytest.approx(np.arange(7) * 0.1)
    assert sample.velocity - true.velocity == pytest.approx(0.2)


def test_heat_reject_and_report(desk: Desk) -> None:
    fault = Fault("bus", 0x40, "BUS_OFF", "a test")
    for trouble in (Heat([3], 95.0), Reject(2), Report(fault)):
        desk.plant(trouble)
    first, second = desk.tick(), desk.tick()
    assert first.temperature[3] == 95.0
    assert (np.delete(first.temperature, 3) < 30.0).all()
    assert (first.rejected, second.rejected) == (2, 4)
    assert second.faults == (fault,)


def test_garble_alters_as_often_as_it_says(desk: Desk) -> None:
    written = []
    write = desk.twin.write
    desk.twin.write = lambda command: written.append(command.position[0]) or write(command)
    desk.plant(Garble(lambda command: command._replace(position=command.position + 1e-3), times=2))
    desk.tick(4)
    assert written == pytest.approx([1e-3, 1e-3, 0.0, 0.0])


def test_a_drive_without_a_watchdog_is_found_by_the_self_test(desk: Desk) -> None:
    desk.plant(NoWatchdog("panda_joint4"))
    with pytest.raises(DriveError, match=r"panda_joint4.*no watchdog"):
        desk.arm.verify()


def test_a_runaway_turns_with_a_torque_of_its_own_while_it_is_on(desk: Desk) -> None:
    desk.plant(Runaway(desk.twin, 6, 2.0))
    desk.tick(10)
    assert desk.twin.truth().effort[6] == pytest.approx(2.0)
    assert desk.twin.truth().velocity[6] > 0.5
    desk.arm.disable()
    desk.tick(3)
    assert desk.twin.truth().effort[6] == 0.0


@pytest.mark.parametrize("mode", list(CommandMode))
@pytest.mark.parametrize("part", [0.5, 0.0])
def test_a_weak_drive_applies_a_part_of_its_torque(mode: CommandMode, part: float) -> None:
    whole, weak = Desk(), Desk()
    weak.plant(Weak(weak.twin, 1, part))
    for desk in (whole, weak):
        desk.tick(1, mode, velocity=np.full(7, 0.05), position=HOME + 0.01)
        desk.clock.sleep_until(desk.clock.now_ns() + 1_000_000)
        desk.twin.read()
    effort = weak.twin.truth().effort
    assert effort[1] == pytest.approx(part * whole.twin.truth().effort[1], abs=0.05)
    assert effort[3] == pytest.approx(whole.twin.truth().effort[3], abs=0.3)


def test_a_drive_that_pushes_the_wrong_way_leads_the_joint_away(desk: Desk) -> None:
    desk.plant(Weak(desk.twin, 0, -1.0))
    desk.tick(40, position=HOME + np.eye(7)[0] * 0.02)
    assert desk.twin.truth().position[0] < HOME[0] - 0.01


def test_commands_that_are_blocked_do_not_reach_the_drives(desk: Desk) -> None:
    desk.twin.blocked = "the transmit queue is full"
    sent = desk.arm.write(Command(CommandMode.TRACK, HOME + 0.1, REST, desk.gravity))
    assert not sent.delivered
    assert sent.altered == "not sent: the transmit queue is full"
    desk.clock.sleep_until(desk.clock.now_ns() + 81_000_000)
    assert not desk.arm.read().enabled
    assert np.abs(desk.twin.truth().position - HOME).max() < 1e-3
