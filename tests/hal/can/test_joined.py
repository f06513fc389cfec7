"""Two arms, each on a bus of its own, as one."""

import errno
from contextlib import suppress

import numpy as np
import pytest

from robotctl.control.frame_replay import replay_states
from robotctl.control.operator import Verb
from robotctl.control.session import LockstepSession, Stopped
from robotctl.hal.backend import open_backend
from robotctl.hal.can.bus_ids import tag, untag
from robotctl.hal.can.channel import channel_names
from robotctl.hal.can.joined import JoinedArm
from robotctl.hal.clock import VirtualClock
from robotctl.hal.errors import BusError, ConfigError, HardwareError
from robotctl.hal.robot import Robot, load_robot
from robotctl.hal.types import Command, CommandMode
from robotctl.safety.guard import Guard
from robotctl.safety.machine import State
from robotctl.safety.target import JointVelocity

ROBOT = load_robot("openarm_bimanual")
PERIOD_S = ROBOT.period_ns * 1e-9
LEFT, RIGHT = slice(0, 7), slice(7, 14)
RIGHT_BUS, LEFT_BUS = 0, 1
UNPLUGGED = OSError(errno.ENODEV, "No such device")


class Session(LockstepSession):
    """A lockstep session whose buses can be reached."""

    def __init__(self) -> None:
        super().__init__(ROBOT, "can")
        self.arm: JoinedArm = self._rig.arm
        self._targets = 0

    def bus(self, number: int):
        return self.arm.arms[number].channel.bus

    def drives(self, number: int):
        return self.bus(number).bench.drives

    def move(self, velocity: np.ndarray, seconds: float) -> None:
        """Ask for a velocity (n,), as a policy does."""
        for _ in range(round(seconds / 0.02)):
            self._targets += 1
            deadline = self.clock.now_ns() + 100_000_000
            self.link.mailbox.put(JointVelocity(velocity, int(self.latest()["epoch"]), self._targets, deadline))
            self.advance(0.02)


@pytest.fixture
def session():
    opened = Session()
    opened.open()
    opened.bus(0).bench.plant.place(np.array(ROBOT.profile.home))
    opened.advance(0.05)
    opened.prepare()
    opened.begin()
    yield opened
    with suppress(HardwareError):  # of a bus that was lost
        opened.close()


def test_both_arms_follow_one_command_and_each_on_its_own_bus(session: Session):
    start = session.latest()["position"].copy()
    wanted = np.zeros(14)
    wanted[0], wanted[7] = -0.3, 0.3
    session.move(wanted, 1.0)
    moved = session.latest()["position"] - start
    assert moved[0] < -0.2
    assert moved[7] > 0.2
    assert np.abs(np.delete(moved, [0, 7])).max() < 0.02
    assert [drive.angle for drive in session.drives(LEFT_BUS)] == pytest.approx(
        session.latest()["true_position"][LEFT], abs=1e-3
    )
    assert [drive.angle for drive in session.drives(RIGHT_BUS)[:7]] == pytest.approx(
        session.latest()["true_position"][RIGHT], abs=1e-3
    )


@pytest.mark.parametrize("lost", [RIGHT_BUS, LEFT_BUS])
def test_losing_one_bus_stops_both_arms(session: Session, lost: int):
    session.move(np.full(14, 0.2), 0.5)
    assert np.abs(session.latest()["true_velocity"]).min() > 0.1
    session.bus(lost).failure = UNPLUGGED
    begun = session.clock.now_ns()
    session.advance(2 * PERIOD_S)
    first = session.trips[0]
    assert first["protection"] == "P14"
    assert "the CAN interface is gone" in first["text"]
    assert session.state is State.STOPPING
    alive = LEFT if lost == RIGHT_BUS else RIGHT
    session.wait_for(State.DISABLED, State.FAULT, timeout_s=3.0)
    assert (session.clock.now_ns() - begun) * 1e-9 < ROBOT.stopping_time_s + 1.0
    assert np.abs(session.latest()["true_velocity"][alive]).max() < 0.05
    # Their own watchdogs have switched off the drives that nobody reaches any more; the others are damped ...
    assert not any(drive.enabled for drive in session.drives(lost))
    assert all(drive.enabled for drive in session.drives(1 - lost))
    session.advance(0.5)
    assert np.abs(session.latest()["true_velocity"][alive]).max() < 1.0
    assert session.state is State.FAULT
    with suppress(Stopped):  # ... until the operator acknowledges; then the arm is lowered first
        session.request(Verb.ACK)
    session.advance(3.0)
    assert not any(drive.enabled for drive in session.drives(0) + session.drives(1))


def test_one_arm_without_power_stops_both_and_nothing_is_left_to_be_sent_to_it(session: Session):
    session.move(np.full(14, 0.2), 0.5)
    bus = session.bus(LEFT_BUS)
    for drive in session.drives(LEFT_BUS):
        drive.power_down()
    session.advance(2 * PERIOD_S)
    assert session.trips[0]["protection"] == "P14"
    assert session.state is State.STOPPING
    session.wait_for(State.DISABLED, State.FAULT, timeout_s=3.0)
    session.advance(0.5)
    assert np.abs(session.latest()["true_velocity"][RIGHT]).max() < 1.0
    assert all(drive.enabled for drive in session.drives(RIGHT_BUS))
    assert 0 < len(bus._waiting) <= 16  # two cycles and what takes torque away: no command joins frames that wait
    with suppress(HardwareError):
        session.close()
    assert not bus._waiting


def test_nothing_of_a_refused_command_leaves_on_either_bus(session: Session):
    guard = session.loop._guard
    before = [session.bus(number).bench.drives[0].fed_ns for number in (0, 1)]
    position = session.latest()["position"].copy()
    position[0] += 1.0  # a jump of the left arm alone
    session.clock.sleep_until(session.clock.now_ns() + ROBOT.period_ns)
    sent = session.arm.write(Command(CommandMode.TRACK, position, np.zeros(14), np.zeros(14)))
    assert not sent.delivered
    assert guard.take() is not None
    assert [session.bus(number).bench.drives[0].fed_ns for number in (0, 1)] == before


def test_each_bus_has_a_white_list_of_its_own():
    guard = Guard(ROBOT, lambda: State.SILENT)
    read = bytes((8, 0, 0x33, 10, 0, 0, 0, 0))  # of motor 8, which only the right bus has
    assert guard.frames([(tag(RIGHT_BUS, 0x7FF), read)]) == ""
    assert "not on the list of this arm, bus 1" in guard.frames([(tag(LEFT_BUS, 0x7FF), read)])
    assert "not on the list of this arm, bus 2" in guard.frames([(tag(2, 0x7FF), read)])
    assert "not on the list" in guard.frames([(tag(LEFT_BUS, 0x308), bytes(8))])


def test_the_last_bus_lost_is_an_error(session: Session):
    session.bus(0).failure = session.bus(1).failure = UNPLUGGED
    with pytest.raises(BusError, match="gone"):
        session.advance(0.01)
    session.bus(0).failure = session.bus(1).failure = None
    for action in (session.arm.read, session.arm.hold):  # nothing goes on by itself when they are back
        with pytest.raises(BusError, match="connect again"):
            action()


def test_what_the_black_box_keeps_of_two_buses_decodes_into_what_was_seen(session: Session):
    session.move(np.full(14, 0.2), 0.3)
    session.frames.mark(1)
    *_, last = replay_states(session.frames.snapshot(), session.frames.description)
    seen = session.arm.read()
    assert (last.position == seen.position).all()
    assert (last.velocity == seen.velocity).all()


def test_all_that_is_wrong_on_both_buses_is_told_at_once():
    clock = VirtualClock(1_000_000_000)
    arm = open_backend("can", ROBOT, clock).arm
    arm.connect()
    for part in arm.arms:
        part.channel.bus.bench.drives[2].power_down()
    with pytest.raises(Exception, match=r"(?s)right_joint3.*left_joint3"):
        arm.verify()
    arm.close()


def test_frames_of_one_bus_that_cannot_be_taken_back_do_not_keep_the_other_open(monkeypatch: pytest.MonkeyPatch):
    arm = open_backend("can", ROBOT, VirtualClock(1_000_000_000)).arm
    arm.connect()

    def purge() -> None:
        raise BusError("frames wait", "take the interface down and up")

    monkeypatch.setattr(arm.arms[0]._transport, "purge", purge)
    with pytest.raises(BusError, match="frames wait"):
        arm.close()
    assert [part.channel for part in arm.arms] == [None, None]


def test_an_id_tells_its_bus():
    assert untag(tag(3, 0x1FFFFFFF)) == (3, 0x1FFFFFFF)
    assert tag(0, 0x123) == 0x123


def test_every_bus_has_a_channel():
    assert channel_names("socketcan:can0,socketcan:can1", ROBOT) == ["socketcan:can0", "socketcan:can1"]
    assert channel_names("emulated", ROBOT) == ["emulated", "emulated"]
    for wrong in ("socketcan:can0", "socketcan:can0,socketcan:can0", "virtual:a,virtual:b,virtual:c"):
        with pytest.raises(ConfigError, match=r"(?s)on 2 buses.*use --channel socketcan:can0,socketcan:can1"):
            channel_names(wrong, ROBOT)


def test_a_channel_that_cannot_be_opened_leaves_none_open():
    arm = open_backend("can", ROBOT, VirtualClock(), "virtual:joined,slcan:/dev/nosuch").arm
    with pytest.raises(BusError, match="nosuch"):
        arm.connect()
    assert arm.channel is None


def test_drives_of_one_arm_are_those_of_its_bus():
    part: Robot = ROBOT.on_bus(LEFT_BUS)
    assert [joint.name for joint in part.profile.joints] == [f"openarm_left_joint{n}" for n in range(1, 8)]
    assert part.profile.gripper is None
    assert ROBOT.on_bus(RIGHT_BUS).profile.gripper is not None
    assert part.dof == len(part.limits.lower) == 7
