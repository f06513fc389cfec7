"""The guard's own reading of CANopen frames."""

import math
import struct

import pytest

from robotctl.hal.profile import RobotProfile
from robotctl.hal.robot import load_robot
from robotctl.safety.asked import Kind, Move
from robotctl.safety.wire import reading_of
from robotctl.safety.wire_402 import Wire402
from robotctl.safety.wire_guard import WireGuard

MEASURED = [(0.0, 0.0)] * 7
COUNTS = 131072 * 100 / (2 * math.pi)


@pytest.fixture(scope="module")
def profile() -> RobotProfile:
    return load_robot("xarm7").profile


@pytest.fixture
def wire(profile: RobotProfile) -> Wire402:
    return reading_of(profile)


def setpoint(word: int = 0x0F, mode: int = 8, position: int = 0) -> bytes:
    return struct.pack("<Hbi", word, mode, position)


def ahead(velocity: int = 0, torque: int = 0) -> bytes:
    return struct.pack("<ih", velocity, torque)


def read(wire: Wire402, *frames: tuple[int, bytes]) -> list[Kind | Move | str]:
    return list(wire.read(frames, MEASURED))


def is_strange(found: list[Kind | Move | str]) -> bool:
    return len(found) == 1 and isinstance(found[0], str) and "is not on the list" in found[0]


# -- motions -----------------------------------------------------------------------------------------------------------


def test_both_frames_together_are_a_motion_of_the_joint(wire: Wire402, profile: RobotProfile) -> None:
    (move,) = read(wire, (0x201, setpoint(position=2_086_075)), (0x301, ahead(1_043_038, 250)))
    gains = profile.joints[0].gains
    assert (move.joint, move.asked.kind) == (0, Kind.TRACK)
    assert move.asked.position == pytest.approx(1.0, abs=1e-6)
    assert move.asked.velocity == pytest.approx(0.5, abs=1e-6)
    assert move.asked.effort == pytest.approx(0.25 * 0.35 * 100)
    assert (move.asked.kp, move.asked.kd) == (gains.kp, gains.kd)


def test_rounding_is_half_a_step(wire: Wire402) -> None:
    (move,) = read(wire, (0x201, setpoint()), (0x301, ahead()))
    assert move.step.position == move.step.velocity == pytest.approx(0.5 / COUNTS, rel=2e-3)
    assert move.step.effort == pytest.approx(0.5e-3 * 35, rel=2e-3)
    assert move.step.position > 0.5 / COUNTS
    assert move.step.effort > 0.5e-3 * 35
    assert (move.step.kp, move.step.kd) == (0.0, 0.0)


def test_a_joint_that_turns_the_other_way_and_one_with_an_offset(wire: Wire402) -> None:
    second, sixth = read(
        wire,
        *((0x202, setpoint(position=-2_086_075)), (0x302, ahead(-2_086_075, -100))),
        *((0x206, setpoint(position=2_086_075)), (0x306, ahead())),
    )
    assert (second.joint, sixth.joint) == (1, 5)
    assert second.asked[1:3] == pytest.approx((1.0, 1.0), abs=1e-6)
    assert second.asked.effort == pytest.approx(3.5)
    assert second.step.position > 0.0
    assert second.step.velocity > 0.0
    assert second.step.effort > 0.0
    assert sixth.asked.position == pytest.approx(2.5708, abs=1e-6)


def test_torque_and_damping_are_told_by_the_mode(wire: Wire402, profile: RobotProfile) -> None:
    kd = profile.joints[2].gains.kd
    (damp,) = read(wire, (0x203, setpoint(mode=9)), (0x303, ahead(10_000, 5)))
    (torque,) = read(wire, (0x203, setpoint(mode=10)), (0x303, ahead(0, -500)))
    speed = 10_000 / COUNTS
    assert damp.asked == (Kind.DAMP, 0.0, pytest.approx(speed), 0.0, kd, pytest.approx(0.1))
    assert torque.asked == (Kind.TORQUE, 0.0, 0.0, 0.0, 0.0, pytest.approx(-10.0))


@pytest.mark.parametrize("mode", [-1, 0, 1, 3, 7, 11])
def test_no_other_mode_leads_a_drive(wire: Wire402, mode: int) -> None:
    assert is_strange(read(wire, (0x201, setpoint(mode=mode)), (0x301, ahead())))


@pytest.mark.parametrize("data", [b"", bytes(5), bytes(7), bytes(8)])
def test_half_of_a_motion_is_refused(wire: Wire402, data: bytes) -> None:
    assert read(wire, (0x201, setpoint())) == ["a setpoint without its feed-forward: half a motion"]
    assert is_strange(read(wire, (0x301, ahead())))
    wrong, half = read(wire, (0x201, setpoint()), (0x301, data))
    assert "is not on the list" in wrong
    assert "half a motion" in half


def test_halves_of_two_joints_are_no_motion(wire: Wire402) -> None:
    found = read(wire, (0x201, setpoint()), (0x302, ahead()))
    assert len(found) == 2
    assert all(isinstance(item, str) for item in found)


def test_a_feed_forward_that_follows_a_whole_motion_is_refused(wire: Wire402) -> None:
    move, strange = read(wire, (0x201, setpoint()), (0x301, ahead()), (0x301, ahead(1_000_000)))
    assert isinstance(move, Move)
    assert "is not on the list" in strange


def test_halves_that_left_before_count_for_nothing(wire: Wire402) -> None:
    read(wire, (0x201, setpoint(0x00)))
    assert is_strange(read(wire, (0x301, ahead())))


@pytest.mark.parametrize("data", [b"", setpoint()[:6], setpoint() + b"\0"])
def test_a_setpoint_of_another_length_is_refused(wire: Wire402, data: bytes) -> None:
    assert is_strange(read(wire, (0x201, data)))


# -- controlwords ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("word", "kind"),
    [(0x00, Kind.DISABLE), (0x02, Kind.DISABLE), (0x06, Kind.ENABLE), (0x07, Kind.ENABLE), (0x80, Kind.CLEAR)],
)
def test_words_of_the_state_machine_have_their_kinds(wire: Wire402, word: int, kind: Kind) -> None:
    assert read(wire, (0x204, setpoint(word))) == [kind]
    assert read(wire, (0x204, setpoint(word)), (0x304, ahead())) == [kind]


@pytest.mark.parametrize("word", [0x01, 0x0E, 0x1F, 0x8F, 0x10F, 0x0F00])
def test_no_other_word_is_known(wire: Wire402, word: int) -> None:
    assert is_strange(read(wire, (0x204, setpoint(word))))


# -- the network -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("frame", [(0x080, b""), (0x77F, b"\x05")])
def test_sync_and_the_host_s_heartbeat_may_always_leave(wire: Wire402, frame: tuple[int, bytes]) -> None:
    assert read(wire, frame) == [Kind.READ]


@pytest.mark.parametrize(
    "frame",
    [
        (0x080, b"\x01"),
        (0x77F, b"\x04"),
        (0x77F, b""),
        (0x701, b"\x05"),
        (0x081, bytes(8)),
        (0x181, bytes(8)),
        (0x123, b""),
    ],
)
def test_what_others_say_is_not_for_the_host_to_say(wire: Wire402, frame: tuple[int, bytes]) -> None:
    assert is_strange(read(wire, frame))


@pytest.mark.parametrize(("command", "kind"), [(0x01, Kind.START), (0x80, Kind.MODE)])
def test_drives_are_started_one_by_one(wire: Wire402, command: int, kind: Kind) -> None:
    assert read(wire, (0x000, bytes((command, 7)))) == [kind]
    for node in (0, 8):
        assert is_strange(read(wire, (0x000, bytes((command, node)))))
    assert is_strange(read(wire, (0x000, bytes((command, 7, 0)))))
    assert is_strange(read(wire, (0x123, bytes((command, 7)))))


@pytest.mark.parametrize("command", [0x02, 0x81, 0x82])
def test_they_are_neither_stopped_nor_reset(wire: Wire402, command: int) -> None:
    assert is_strange(read(wire, (0x000, bytes((command, 7)))))


# -- transfers ---------------------------------------------------------------------------------------------------------


def transfer(command: int, index: int, value: int = 0) -> tuple[int, bytes]:
    return 0x601, struct.pack("<BHBI", command, index, 0, value)


@pytest.mark.parametrize("command", [0x40, 0x60, 0x70, 0x80])
def test_reading_is_reading(wire: Wire402, command: int) -> None:
    assert read(wire, transfer(command, 0x6040)) == [Kind.READ]


@pytest.mark.parametrize(
    "index", [0x1400, 0x1401, 0x1600, 0x1601, 0x1800, 0x1801, 0x1A00, 0x1A01, 0x60C2, 0x60FF, 0x6071]
)
def test_what_lays_out_the_frames_is_a_setting(wire: Wire402, index: int) -> None:
    assert read(wire, transfer(0x23, index)) == [Kind.MODE]


@pytest.mark.parametrize("index", [0x60FF, 0x6071])
def test_targets_that_pdos_leave_alone_may_only_be_zero(wire: Wire402, index: int) -> None:
    for byte in range(4):
        assert read(wire, transfer(0x23, index, 1 << 8 * byte)) == [Kind.STORE]


@pytest.mark.parametrize("index", [0x1010, 0x1016, 0x1017, 0x1402, 0x6007, 0x6040, 0x6060, 0x607A, 0x607C, 0x60B1])
def test_everything_else_that_is_written_is_refused_everywhere(wire: Wire402, index: int) -> None:
    assert read(wire, transfer(0x23, index)) == [Kind.STORE]


@pytest.mark.parametrize("command", [0x00, 0xA0, 0xC0, 0xE0])
def test_other_transfers_are_taken_for_writing(wire: Wire402, command: int) -> None:
    assert read(wire, transfer(command, 0x1400)) == [Kind.STORE]


def test_transfers_with_others_or_of_another_length_are_refused(wire: Wire402) -> None:
    assert is_strange(read(wire, (0x608, bytes(8))))
    assert is_strange(read(wire, (0x600, bytes(8))))
    assert is_strange(read(wire, (0x601, bytes(7))))


def test_the_sub_index_changes_nothing(wire: Wire402) -> None:
    assert read(wire, (0x601, bytes.fromhex("23 16 10 01 00 00 00 00"))) == [Kind.STORE]
    assert read(wire, (0x601, bytes.fromhex("23 00 14 01 00 00 00 00"))) == [Kind.MODE]


# -- arms --------------------------------------------------------------------------------------------------------------


def test_the_reading_is_that_of_the_drives() -> None:
    assert isinstance(reading_of(load_robot("panda").profile), WireGuard)
    assert isinstance(reading_of(load_robot("kinova").profile), WireGuard)


def test_a_gripper_of_another_protocol_is_read_as_such() -> None:
    wiring = "{{protocol: cia402, id: {}, resolution: 65536, rated_torque: 0.9, gear: 50.0}}"
    drives = [f"joints.{axis}.drive={wiring.format(axis + 1)}" for axis in range(7)]
    wire = reading_of(load_robot("panda", ["servo_hz=200", "can.fd=false", *drives]).profile)
    enable = b"\xff" * 7 + b"\xfc"
    grip = struct.pack("<fHH", 1.0, 100, 100)
    assert read(wire, (0x008, enable), (0x080, b""), (0x308, grip)) == [Kind.ENABLE, Kind.READ, Kind.GRIP]
    assert is_strange(read(wire, (0x001, enable)))
    assert isinstance(read(wire, (0x201, setpoint()), (0x301, ahead()))[0], Move)
