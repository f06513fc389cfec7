"""The guard's own reading of DAMIAO frames."""

import math

import pytest

from robotctl.hal.can.bus_ids import tag
from robotctl.hal.can.damiao.codec import (
    BROADCAST_ID,
    MitCommand,
    Offset,
    PosForceCommand,
    RegisterCommand,
    Special,
    encode_mit,
    encode_pos_force,
    encode_register,
    encode_special,
)
from robotctl.hal.can.damiao.motors import MOTORS
from robotctl.hal.can.damiao.registers import Register
from robotctl.hal.robot import load_robot
from robotctl.safety.asked import Kind, stranger
from robotctl.safety.wire_guard import WireGuard

ROBOTS = [load_robot(name) for name in ("panda", "openarm")]
PANDA = ROBOTS[0]
WIRE = WireGuard(PANDA.profile)
MOTION = encode_mit(MitCommand(0.0, 0.0, 1.0, 1.0, 0.0), MOTORS["DM4340"])
GRIPPER = PANDA.profile.gripper
GRIP_ID = GRIPPER.drive.id + Offset.POS_FORCE
PER_METRE = GRIPPER.motor_open / GRIPPER.width


@pytest.mark.parametrize("robot", ROBOTS)
def test_every_joint_is_read_back_in_its_own_coordinates(robot):
    wire = WireGuard(robot.profile)
    for index, joint in enumerate(robot.profile.joints):
        drive, ranges = joint.drive, MOTORS[joint.drive.motor]
        scale = drive.sign * drive.gear
        position, velocity = 0.7 * joint.position[1], -0.4 * joint.velocity
        kp, kd, effort = 0.8 * joint.gains.kp, 0.5 * joint.gains.kd, 0.3 * joint.torque
        command = MitCommand(
            scale * (position - drive.offset), scale * velocity, kp / scale**2, kd / scale**2, effort / scale
        )
        data = encode_mit(command, ranges)
        assert wire.kind(drive.id, data) == index
        step = wire.joints[index].step
        asked = wire.joints[index].asked(data, position)
        for value, wanted, off in zip(asked[1:], (position, velocity, kp, kd, effort), step, strict=True):
            assert abs(value - wanted) <= off


def test_the_resolution_is_half_a_step_of_each_field():
    step = WIRE.joints[4].step  # DM4340: 12.5 rad, 10 rad/s, 28 Nm
    wanted = (12.5 / 65535, 10.0 / 4095, 250.0 / 4095, 2.5 / 4095, 28.0 / 4095)
    assert step == pytest.approx(wanted, rel=2e-3)
    assert all(value > half for value, half in zip(step, wanted, strict=True))


def test_gears_and_signs_are_the_profiles():
    joint = PANDA.profile.joints[4]
    drive = joint.drive.model_copy(update={"gear": 2.0, "sign": -1, "offset": 0.5})
    profile = PANDA.profile.model_copy(update={"joints": [joint.model_copy(update={"drive": drive})]})
    geared = WireGuard(profile).joints[0]
    asked = geared.asked(encode_mit(MitCommand(1.0, 2.0, 3.0, 0.5, 4.0), MOTORS["DM4340"]), 0.0)
    for value, wanted, off in zip(asked[1:], (0.0, -1.0, 12.0, 2.0, -8.0), geared.step, strict=True):
        assert abs(value - wanted) <= off
    assert geared.step == pytest.approx(
        (12.5 / 65535 / 2, 10.0 / 4095 / 2, 1000.0 / 4095, 10.0 / 4095, 56.0 / 4095), rel=2e-3
    )


@pytest.mark.parametrize("turns", [-1, 0, 1])
@pytest.mark.parametrize("gear", [1.0, 2.0])
def test_a_joint_that_woke_up_a_turn_off_is_read_where_it_is(turns, gear):
    joint = PANDA.profile.joints[6]
    drive = joint.drive.model_copy(update={"gear": gear})
    profile = PANDA.profile.model_copy(update={"joints": [joint.model_copy(update={"drive": drive})]})
    wire = WireGuard(profile).joints[0]
    data = encode_mit(MitCommand(0.3 * gear, 0.0, 1.0, 1.0, 0.0), MOTORS["DM4340"])
    turn = 2.0 * math.pi / gear
    for measured in (0.3, 0.3 + 0.49 * turn, 0.3 - 0.49 * turn):
        assert wire.asked(data, measured + turns * turn).position == pytest.approx(0.3 + turns * turn, abs=3e-4)
    for measured, read in ((0.4 * turn, 0.3), (-0.6 * turn, 0.3 - turn), (0.3 + 0.6 * turn, 0.3 + turn)):
        assert wire.asked(data, measured).position == pytest.approx(read, abs=3e-4)
    far = encode_mit(MitCommand(5.0 * gear, 0.0, 1.0, 1.0, 0.0), MOTORS["DM4340"])
    assert wire.asked(far, 5.0 - 0.6 * turn).position == pytest.approx(5.0 - turn, abs=3e-4)
    # No more than one turn: what is further off is a bump.
    assert wire.asked(data, 0.3 + 2.0 * turn).position == pytest.approx(0.3 + turn, abs=3e-4)
    assert wire.asked(data, math.nan).position == pytest.approx(0.3, abs=3e-4)


@pytest.mark.parametrize(("special", "kind"), [
    (Special.ENABLE, Kind.ENABLE), (Special.DISABLE, Kind.DISABLE),
    (Special.CLEAR_ERROR, Kind.CLEAR), (Special.SET_ZERO, Kind.ZERO),
])  # fmt: skip
def test_special_frames(special, kind):
    for motor in range(1, 9):
        assert WIRE.kind(motor, encode_special(special)) is kind


def test_special_frames_that_nobody_knows_are_strange():
    for last in set(range(256)) - set(Special):
        assert WIRE.kind(1, b"\xff" * 7 + bytes([last])) is None


@pytest.mark.parametrize(("command", "register", "kind"), [
    (RegisterCommand.READ, 7, Kind.READ), (RegisterCommand.REFRESH, 0, Kind.READ),
    (RegisterCommand.WRITE, Register.CTRL_MODE, Kind.MODE), (RegisterCommand.WRITE, Register.TIMEOUT, Kind.STORE),
    (RegisterCommand.SAVE, Register.CTRL_MODE, Kind.STORE), (0x99, Register.CTRL_MODE, Kind.STORE),
])  # fmt: skip
def test_register_frames(command, register, kind):
    for motor in range(1, 9):
        assert WIRE.kind(BROADCAST_ID, bytes((motor, 0, command, register, 0, 0, 0, 0))) is kind
    assert WIRE.kind(BROADCAST_ID, bytes((9, 0, command, register, 0, 0, 0, 0))) is None
    assert WIRE.kind(BROADCAST_ID, bytes((1, 1, command, register, 0, 0, 0, 0))) is None


def test_what_looks_like_a_register_frame_on_another_id_is_strange():
    assert WIRE.kind(0x123, encode_register(1, RegisterCommand.READ, 7)) is None


def test_every_other_id_is_strange():
    known = {*range(1, 8), GRIP_ID, BROADCAST_ID}
    for arbitration_id in set(range(0x800)) - known:
        assert WIRE.kind(arbitration_id, MOTION) is None
    for arbitration_id in (0x800, 0x1FFFFFFF, -1):
        assert WIRE.kind(arbitration_id, MOTION) is None


@pytest.mark.parametrize("length", [0, 1, 4, 7, 9, 64])
def test_frames_of_another_length_are_strange(length):
    for arbitration_id in (1, GRIP_ID, BROADCAST_ID):
        assert WIRE.kind(arbitration_id, bytes(length)) is None


def test_the_grippers_motor_takes_no_motion_in_mit_mode():
    assert WIRE.kind(GRIPPER.drive.id, MOTION) is None
    assert WIRE.kind(GRIPPER.drive.id, encode_special(Special.DISABLE)) is Kind.DISABLE


def grip(angle=1.0, speed=None, current=None, robot=PANDA):
    gripper = robot.profile.gripper
    per_metre = abs(gripper.motor_open) / gripper.width
    speed = gripper.speed * per_metre if speed is None else speed
    most = gripper.force / per_metre / MOTORS[gripper.drive.motor].tmax
    data = encode_pos_force(PosForceCommand(angle, speed, most if current is None else current * most))
    return WireGuard(robot.profile).kind(gripper.drive.id + Offset.POS_FORCE, data)


@pytest.mark.parametrize(("angle", "kind"), [
    (0.0, Kind.GRIP), (4.0, Kind.GRIP), (-0.19, Kind.GRIP), (-0.21, None),
    (4.19, Kind.GRIP), (4.21, None), (math.nan, None),
])  # fmt: skip
def test_the_gripper_stays_within_its_stroke(angle, kind):
    assert grip(angle) is kind


def test_a_gripper_that_opens_backwards():
    robot = ROBOTS[1]
    for angle, kind in [(0.05, Kind.GRIP), (0.06, None), (-1.09, Kind.GRIP), (-1.11, None)]:
        assert grip(angle, robot=robot) is kind


def test_the_gripper_is_no_faster_and_no_stronger_than_its_profile():
    speed = GRIPPER.speed * PER_METRE
    assert grip(speed=speed + 0.03) is Kind.GRIP
    assert grip(speed=speed + 0.05) is None
    assert grip(current=1.005) is Kind.GRIP
    assert grip(current=1.05) is None
    most = GRIPPER.force / PER_METRE / MOTORS[GRIPPER.drive.motor].tmax
    assert grip(current=(most + 0.9e-3) / most) is Kind.GRIP
    assert grip(current=(most + 1.3e-3) / most) is None


def test_a_grip_force_beyond_the_motors_is_full_current():
    strong = GRIPPER.model_copy(update={"force": 1e6})
    wire = WireGuard(PANDA.profile.model_copy(update={"gripper": strong}))
    assert wire.kind(GRIP_ID, encode_pos_force(PosForceCommand(1.0, 1.0, 1.0))) is Kind.GRIP
    assert wire.kind(GRIP_ID, bytes(6) + (12_000).to_bytes(2, "little")) is None


def test_an_arm_without_a_grippers_motor_has_no_grip():
    for gripper in (None, GRIPPER.model_copy(update={"drive": None})):
        wire = WireGuard(PANDA.profile.model_copy(update={"gripper": gripper}))
        assert wire.kind(GRIP_ID, encode_pos_force(PosForceCommand(1.0, 1.0, 0.1))) is None
        assert wire.kind(GRIPPER.drive.id, encode_special(Special.ENABLE)) is None
        assert wire.kind(-1, MOTION) is None


def test_an_arm_without_drives_has_no_frames():
    wire = WireGuard(load_robot("xarm7").profile)
    assert wire.joints == []
    assert wire.kind(1, MOTION) is None
    assert wire.kind(BROADCAST_ID, encode_register(1, RegisterCommand.READ)) is None


def test_a_stranger_is_told_with_its_bus_where_there_are_several():
    data = bytes([1, 2])
    assert stranger(0x123, data) == "frame 123#0102 is not on the list of this arm"
    assert stranger(tag(1, 0x123), data) == "frame 123#0102 is not on the list of this arm, bus 1"
