"""An arm on CiA 402 drives with a gripper on a DAMIAO drive, on one bus."""

from collections.abc import Iterator

import numpy as np
import pytest

from robotctl.control.session import LockstepSession
from robotctl.hal.errors import DriveError
from robotctl.hal.robot import Robot
from robotctl.safety.machine import State
from robotctl.safety.target import JointVelocity
from robotctl.sim.motors.cia402 import Cia402Drive
from robotctl.sim.motors.damiao import DamiaoDrive
from robotctl.sim.motors.trouble import Failure, Mute

from .conftest import Desk


@pytest.fixture
def pair(mixed: Robot) -> Iterator[Desk]:
    made = Desk(mixed)
    yield made
    made.arm.close()


def test_both_kinds_of_drive_are_on_the_bus(pair: Desk):
    kinds = [type(drive) for drive in pair.bench.drives]
    assert kinds == [Cia402Drive] * 7 + [DamiaoDrive]


def test_they_come_on_move_and_go_off_together(pair: Desk):
    pose = pair.enable()
    assert pair.drive("gripper").enabled
    pair.arm.gripper.command(0.06, 20.0)
    pair.tick(pair.seconds(1.5), pair.hold())
    assert pair.arm.gripper.read().width == pytest.approx(0.06, abs=0.004)
    assert np.abs(pair.arm.read().position - pose).max() < 0.01
    pair.arm.disable()
    assert not any(drive.enabled for drive in pair.bench.drives)


def test_a_gripper_that_is_not_as_the_profile_says_is_refused_with_the_arm(pair: Desk):
    pair.drive("gripper").set_watchdog(0.0)
    with pytest.raises(DriveError, match=r"gripper.*no watchdog"):
        pair.arm.verify()


def test_a_fault_of_the_gripper_is_told_and_keeps_the_arm_off(pair: Desk):
    pair.enable()
    pair.bench.trouble.add(Failure(motor_id=8))
    sample = pair.tick(10, pair.hold())
    assert [(fault.joint, fault.name) for fault in sample.faults] == [("gripper", "OVER_CURRENT")]
    pair.arm.disable()
    with pytest.raises(DriveError, match=r"gripper.*OVER_CURRENT"):
        pair.arm.enable()
    pair.arm.clear_faults()
    pair.arm.enable()


def test_a_gripper_that_does_not_confirm_leaves_the_arm_off(pair: Desk):
    pair.enable()
    pair.bench.trouble.add(Mute(motor_id=8))
    with pytest.raises(DriveError, match="gripper"):
        pair.arm.disable()
    assert not any(drive.enabled for drive in pair.bench.drives)


def test_a_whole_session_under_the_guard(mixed: Robot):
    with LockstepSession(mixed, "can") as session:
        session.prepare()
        session.begin()
        gripper = session._rig.gripper
        for step in range(40):
            if step == 5:
                gripper.command(0.02, 20.0)
            velocity = 0.5 * np.sin(0.3 * step) * mixed.limits.velocity
            deadline = session.clock.now_ns() + 100_000_000
            session.link.mailbox.put(JointVelocity(velocity, int(session.latest()["epoch"]), step, deadline))
            session.advance(0.05)
        assert session.state is State.RUN
        assert session.trips == []
        assert sum(session.judge.violations.values()) == 0
        assert gripper.read().width == pytest.approx(0.02, abs=0.004)
        assert session._rig.arm._transport.withheld == 0
