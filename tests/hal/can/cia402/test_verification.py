"""Every refusal of bring-up, and what it tells the person who has to fix it."""

import pytest

from robotctl.hal.can.cia402 import objects as od
from robotctl.hal.can.cia402.codec import Mode, Nmt, Service
from robotctl.hal.can.cia402.machine import State
from robotctl.hal.can.cia402.objects import Entry
from robotctl.hal.can.cia402.verification import cycle_time
from robotctl.hal.can.problems import DrivesError
from robotctl.hal.errors import ConfigError, DriveError
from robotctl.hal.robot import load_robot
from robotctl.sim.motors.trouble import Mute, PowerCut

HOST = 127 << 16


def test_a_sound_arm_is_known_afterwards(desk):
    desk.arm.verify()
    assert desk.arm.warnings == []
    identity = desk.arm.identities["joint3"]
    assert (identity.resolution, identity.rated_torque, identity.timeout_s) == (131072, 0.2, 0.08)
    assert all(drive.nmt is Nmt.OPERATIONAL for drive in desk.bench.drives)
    assert all(drive.state is State.OFF for drive in desk.bench.drives)


@pytest.mark.parametrize(
    ("entry", "value", "words"),
    [
        (od.DEVICE_TYPE, 401, "profile 401, not 402"),
        (od.INCREMENTS, 65536, "counts 65536 increments a turn, the profile says 131072"),
        (od.REVOLUTIONS, 2, "counts 65536 increments a turn"),
        (od.RATED_TORQUE, 400, r"rated torque is 0\.4 Nm, the profile says 0\.35"),
        (od.HEARTBEAT_CONSUMER, 0, "no watchdog"),
        (od.HEARTBEAT_CONSUMER, HOST, "no watchdog"),
        (od.HEARTBEAT_CONSUMER, 5 << 16 | 80, "heartbeat of node 5"),
        (od.HEARTBEAT_CONSUMER, HOST | 101, "waits 101 ms, 100 ms are allowed"),
        (od.ABORT_OPTION, 0, "does nothing when the host's heartbeat is lost"),
        (od.HEARTBEAT_PRODUCER, 0, "sends no heartbeat"),
        (od.HEARTBEAT_PRODUCER, 1000, "sends its heartbeat every 1000 ms"),
        (od.SUPPORTED_MODES, 0x0180, r"lacks the cyclic synchronous modes 10 \(torque\)"),
        (od.MAX_TORQUE, 1000, r"gives at most 35\.0 Nm at the joint, its cap is 50"),
        (od.MAX_MOTOR_SPEED, 900, "turns at most at 900 /min, the joint's velocity cap takes 955"),
        (od.VELOCITY_UNIT, 0x00B44700, "unit of velocity is 0x00B44700"),
    ],
)
def test_a_drive_that_is_not_as_the_profile_says_is_refused(desk, entry: Entry, value: int, words: str):
    desk.drive(1).preset(entry, value)
    with pytest.raises(DriveError, match=words) as refusal:
        desk.arm.verify()
    assert refusal.value.remedy
    assert "joint1" in str(refusal.value)


def test_the_longest_heartbeat_allowed_is_allowed(desk):
    desk.drive(1).preset(od.HEARTBEAT_CONSUMER, HOST | 100)
    desk.arm.verify()


@pytest.mark.parametrize("option", [1, 2, 3])
def test_whatever_a_drive_does_when_the_host_is_lost_is_taken(desk, option: int):
    desk.drive(1).preset(od.ABORT_OPTION, option)
    desk.arm.verify()


@pytest.mark.parametrize(("key", "entry"), [("vendor", od.VENDOR), ("product", od.PRODUCT)])
def test_another_maker_s_drive_is_refused_where_the_profile_names_one(key: str, entry: Entry):
    from .conftest import Desk

    desk = Desk(load_robot("xarm7", [f"joints.0.drive.{key}=291"]))
    desk.arm.verify()
    desk.drive(1).preset(entry, 0x124)
    with pytest.raises(DriveError, match="is 0x00000124, the profile says 0x00000123"):
        desk.arm.verify()


def test_optional_objects_may_be_missing_but_it_is_said(desk):
    for entry in (od.VELOCITY_UNIT, od.MAX_MOTOR_SPEED, od.SERIAL):
        del desk.drive(2).dictionary.entries[entry.index, entry.sub]
    desk.arm.verify()
    assert desk.arm.warnings == ["joint2: does not tell its unit of velocity; increments/s are taken for granted"]


def test_mandatory_objects_may_not(desk):
    del desk.drive(2).dictionary.entries[0x6502, 0]
    with pytest.raises(DriveError, match="does not tell 0x6502"):
        desk.arm.verify()


def test_everything_that_is_wrong_is_told_at_once(desk):
    desk.drive(1).preset(od.HEARTBEAT_CONSUMER, 0)
    desk.drive(1).preset(od.MAX_TORQUE, 1)
    desk.drive(6).preset(od.RATED_TORQUE, 1)
    with pytest.raises(DrivesError) as refusal:
        desk.arm.verify()
    assert [problem.joint for problem in refusal.value.problems] == ["joint1", "joint1", "joint6"]


def test_where_anything_is_wrong_nothing_is_written_to_that_drive(desk):
    desk.drive(1).preset(od.HEARTBEAT_CONSUMER, 0)
    with pytest.raises(DriveError):
        desk.arm.verify()
    to_first = [data for arbitration_id, data in desk.sent if arbitration_id == Service.SDO + 1]
    assert {data[0] >> 5 for data in to_first} == {2}
    assert desk.drive(1).nmt is Nmt.PRE_OPERATIONAL


def test_a_silent_drive_is_asked_again_and_then_named(desk):
    desk.bench.trouble.add(Mute(motor_id=4))
    with pytest.raises(DriveError, match=r"joint4 .*does not answer \(5 requests\)"):
        desk.arm.verify()


def test_a_stale_fault_is_shown_and_stays(desk):
    desk.drive(3).fail(0x8611)
    with pytest.raises(DriveError, match="reports FOLLOWING_ERROR"):
        desk.arm.verify()
    assert desk.drive(3).state is State.FAULT
    desk.arm.clear_faults()
    assert desk.drive(3).state is State.OFF
    desk.arm.verify()


def test_a_drive_that_somebody_else_has_enabled_is_refused(desk):
    desk.drive(5).state = State.ENABLED
    with pytest.raises(DriveError, match="OPERATION ENABLED"):
        desk.arm.verify()


def test_a_joint_that_is_where_it_cannot_be_is_refused(desk):
    desk.home[3] = -0.4
    desk.bench.plant.place(desk.home)
    with pytest.raises(DriveError, match=r"measures -0\.4.*outside its joint's range"):
        desk.arm.verify()


def test_the_pdos_are_mapped_as_the_codec_has_them(desk):
    desk.arm.verify()
    values = desk.drive(7).dictionary.values
    assert [values[0x1400, 1], values[0x1401, 1], values[0x1800, 1], values[0x1801, 1]] == [0x207, 0x307, 0x187, 0x287]
    assert {values[index, 2] for index in (0x1400, 0x1401, 0x1800, 0x1801)} == {1}
    mapping = [
        [values[base, sub] for sub in range(1, values[base, 0] + 1)] for base in (0x1600, 0x1601, 0x1A00, 0x1A01)
    ]
    assert mapping == [
        [0x60400010, 0x60600008, 0x607A0020],
        [0x60B10020, 0x60B20010],
        [0x60410010, 0x60640020, 0x60770010],
        [0x606C0020, 0x60610008],
    ]
    assert (values[0x60C2, 1], values[0x60C2, 2]) == (5, -3)


def test_a_restart_is_noticed_and_wants_another_verification(desk):
    desk.arm.verify()
    cut = PowerCut(motor_id=2)
    desk.bench.trouble.add(cut)
    desk.tick(2)
    desk.bench.trouble.remove(cut)
    fault = desk.tick(2).faults[0]
    assert (fault.joint, fault.name) == ("joint2", "NOT_OPERATIONAL")
    with pytest.raises(DriveError, match="has restarted since it was verified"):
        desk.arm.enable()
    desk.arm.verify()
    assert desk.tick(2).faults == ()


@pytest.mark.parametrize(
    ("seconds", "words"), [(0.005, (5, -3)), (0.0025, (25, -4)), (0.02, (20, -3)), (1 / 300, (33, -4)), (0.3, (30, -2))]
)
def test_cycle_times_fit_a_byte(seconds: float, words: tuple[int, int]):
    assert cycle_time(seconds) == words


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("can.fd=true", "classic CAN"),
        ("category0=damp", "cannot lower an arm"),
        ("servo_hz=250", None),
        ("joints.0.drive.resolution=2147483647", "32 bits of a position"),
        ("joints.0.drive.rated_torque=0.001", "exceeds what the wire can say"),
        ("joints.0.drive.id=127", "less than or equal to 126"),
        ("joints.0.drive.id=2", "used by more than one motor"),
    ],
)
def test_profiles_that_the_wire_cannot_carry_are_refused(override: str, words: str | None):
    if words is None:
        load_robot("xarm7", [override])
        return
    with pytest.raises(ConfigError, match=words):
        load_robot("xarm7", [override])


def test_the_modes_that_are_needed_are_those_that_are_used():
    assert {Mode.POSITION, Mode.VELOCITY, Mode.TORQUE} == set(Mode) - {Mode.NONE}
