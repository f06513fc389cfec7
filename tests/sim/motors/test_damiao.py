"""What one drive does with every kind of frame, and with time. Time is in ns of the plant."""

import math
import struct

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robotctl.hal.can.damiao.codec import (
    BROADCAST_ID,
    Feedback,
    MitCommand,
    Offset,
    PosForceCommand,
    PosVelCommand,
    RegisterCommand,
    Special,
    Status,
    decode_feedback,
    encode_feedback,
    encode_mit,
    encode_pos_force,
    encode_pos_vel,
    encode_register,
    encode_special,
    encode_vel,
)
from robotctl.hal.can.damiao.registers import REGISTERS, ControlMode, Register, decode_value, encode_value
from robotctl.hal.robot import load_robot
from robotctl.sim.motors.bench import Bench

MS = 1_000_000
MOTOR = 7
ROBOT = load_robot("panda")
GRIPPER = 8


class Host:
    """Sends frames to a bench and hands back what is answered."""

    def __init__(self, robot=ROBOT, **options) -> None:
        self.bench = Bench(robot, **options)
        self.drive = self.bench.drive(MOTOR)

    def wait(self, milliseconds: float) -> None:
        self.bench.advance(self.bench.now_ns + round(milliseconds * MS))

    def replies(self, arbitration_id: int, data: bytes) -> list:
        self.bench.receive(arbitration_id, data)
        replies = list(self.bench.replies)
        self.bench.replies.clear()
        return replies

    def ask(self, arbitration_id: int, data: bytes, motor: int = MOTOR) -> Feedback:
        (reply,) = self.replies(arbitration_id, data)
        drive = self.bench.drive(motor)
        assert reply.arbitration_id == drive.reply_id
        return decode_feedback(reply.data, drive.ranges)

    def special(self, command: Special, motor: int = MOTOR) -> Feedback:
        return self.ask(motor, encode_special(command), motor)

    def mit(self, position=0.0, velocity=0.0, kp=0.0, kd=0.0, effort=0.0, motor: int = MOTOR) -> Feedback:
        command = MitCommand(position, velocity, kp, kd, effort)
        return self.ask(motor, encode_mit(command, self.bench.drive(motor).ranges), motor)

    def refresh(self, motor: int = MOTOR) -> Feedback:
        return self.ask(BROADCAST_ID, encode_register(motor, RegisterCommand.REFRESH), motor)

    def read(self, register: int, motor: int = MOTOR) -> float:
        (reply,) = self.replies(BROADCAST_ID, encode_register(motor, RegisterCommand.READ, register))
        assert reply.data[:4] == bytes((motor, 0, RegisterCommand.READ, register))
        return decode_value(register, reply.data[4:])

    def write(self, register: int, value: float, motor: int = MOTOR):
        raw = encode_value(register, value)
        return self.replies(BROADCAST_ID, encode_register(motor, RegisterCommand.WRITE, register, raw))

    def save(self, motor: int = MOTOR):
        return self.replies(BROADCAST_ID, encode_register(motor, RegisterCommand.SAVE, 1))


@pytest.fixture
def host() -> Host:
    return Host()


# --- feedback ---------------------------------------------------------------------------------------------------------


def test_every_drive_starts_disabled_and_answers(host: Host) -> None:
    for drive in host.bench.drives:
        feedback = host.refresh(drive.id)
        assert feedback.status == Status.DISABLED
        assert feedback.motor == drive.id
        position, velocity, effort = drive.shaft.state()
        assert feedback == decode_feedback(
            encode_feedback(Feedback(drive.id, 0, position, velocity, effort, 25, 25), drive.ranges), drive.ranges
        )


@settings(max_examples=50, deadline=None)
@given(st.floats(-30, 30), st.floats(-100, 100), st.floats(-300, 300))
def test_feedback_is_the_codecs(position: float, velocity: float, effort: float) -> None:
    drive = Host().drive

    class Stub:
        def state(self):
            return position, velocity, effort

    drive.shaft = Stub()
    expected = encode_feedback(Feedback(drive.id, 0, position, velocity, effort, 25, 25), drive.ranges)
    difference = int.from_bytes(drive.feedback(), "big") ^ int.from_bytes(expected, "big")
    # Where a value falls on the border of two steps, one rounding of the float may decide otherwise.
    assert difference == 0 or abs(decode_feedback(drive.feedback(), drive.ranges).position - position) < 4e-4


def test_joint_angles_go_through_sign_gear_and_offset(host: Host) -> None:
    for drive, joint, home in zip(host.bench.drives, ROBOT.profile.joints, ROBOT.profile.home, strict=False):
        wiring = joint.drive
        expected = wiring.sign * wiring.gear * (home - wiring.offset)
        assert host.refresh(drive.id).position == pytest.approx(expected, abs=4e-4)


@pytest.mark.parametrize("offset", list(Offset))
def test_frames_to_every_offset_are_answered_by_one_feedback(host: Host, offset: Offset) -> None:
    for enable in (False, True):
        if enable:
            host.special(Special.ENABLE)
        assert host.ask(MOTOR + offset, bytes(8)).status == int(enable)
        assert host.ask(MOTOR + offset, encode_special(Special.ENABLE)).status == Status.ENABLED
        host.special(Special.DISABLE)


def test_velocity_frames_of_four_bytes(host: Host) -> None:
    host.write(Register.CTRL_MODE, ControlMode.VEL)
    host.special(Special.ENABLE)
    assert host.ask(MOTOR + Offset.VEL, encode_vel(0.5)).status == Status.ENABLED


@pytest.mark.parametrize("data", [b"", b"\xff" * 4, b"\0" * 7, b"\0" * 12, b"\xff" * 64])
@pytest.mark.parametrize("identifier", [MOTOR, MOTOR + 0x100, MOTOR + 0x300, BROADCAST_ID, 0, 0x7FE, 0x50])
def test_frames_that_make_no_sense_are_not_answered(host: Host, identifier: int, data: bytes) -> None:
    assert host.replies(identifier, data) == []


@settings(max_examples=200, deadline=None)
@given(st.lists(st.tuples(st.integers(0, 0x7FF), st.binary(max_size=64), st.floats(0, 5)), max_size=20))
def test_no_frame_breaks_a_bench(frames: list) -> None:
    host = Host()
    for identifier, data, pause in frames:
        host.wait(pause)
        host.bench.receive(identifier, data)


# --- enable, modes, laws ----------------------------------------------------------------------------------------------


def test_commands_before_enabling_do_nothing(host: Host) -> None:
    before = host.refresh().position
    for _ in range(50):
        assert host.mit(effort=5.0).status == Status.DISABLED
        host.wait(2)
    assert host.refresh().position == before


def test_mit_law(host: Host) -> None:
    host.special(Special.ENABLE)
    start = host.refresh().position
    for _ in range(300):
        feedback = host.mit(start + 0.3, 0.0, 20.0, 1.0)
        host.wait(2)
    assert feedback.position == pytest.approx(start + 0.3, abs=0.02)
    assert host.mit(start + 0.3, 0.0, 20.0, 1.0).status == Status.ENABLED


def test_signs_and_offsets_do_not_matter_to_the_law(host: Host) -> None:
    # Joint 4 turns against its motor.
    host.special(Special.ENABLE, 4)
    start = host.refresh(4).position
    for _ in range(500):
        host.mit(start + 0.2, 0.0, 300.0, 5.0, host.bench.drive(4).shaft.state()[2], motor=4)
        host.wait(2)
    assert host.refresh(4).position - start == pytest.approx(0.2, abs=0.1)


def test_effort_comes_back(host: Host) -> None:
    host.special(Special.ENABLE)
    host.mit(effort=1.0)
    host.wait(2)
    assert host.refresh().effort == pytest.approx(1.0, abs=0.014)


def test_a_mode_write_while_enabled_is_lost_but_acknowledged(host: Host) -> None:
    host.special(Special.ENABLE)
    (reply,) = host.write(Register.CTRL_MODE, ControlMode.VEL)
    assert reply.data == bytes.fromhex("0700550A03000000")
    assert host.read(Register.CTRL_MODE) == ControlMode.MIT
    host.special(Special.DISABLE)
    host.write(Register.CTRL_MODE, ControlMode.VEL)
    assert host.read(Register.CTRL_MODE) == ControlMode.VEL


def test_commands_of_another_mode_are_ignored(host: Host) -> None:
    host.special(Special.ENABLE)
    start = host.refresh().position
    for _ in range(50):
        host.ask(MOTOR + Offset.POS_VEL, encode_pos_vel(PosVelCommand(start + 1.0, 5.0)))
        host.ask(MOTOR + Offset.VEL, encode_vel(2.0))
        host.wait(2)
    assert host.refresh().position == pytest.approx(start, abs=0.05)


def test_a_mode_switch_clears_command_values(host: Host) -> None:
    host.special(Special.ENABLE)
    host.mit(effort=2.0)
    host.special(Special.DISABLE)
    host.write(Register.CTRL_MODE, ControlMode.POS_VEL)
    host.write(Register.CTRL_MODE, ControlMode.MIT)
    host.special(Special.ENABLE)
    host.wait(2)
    assert host.refresh().effort == pytest.approx(0.0, abs=0.014)


def test_pos_vel_goes_there_at_the_given_speed_and_stays(host: Host) -> None:
    host.write(Register.CTRL_MODE, ControlMode.POS_VEL)
    host.special(Special.ENABLE)
    start = host.refresh().position
    frame = encode_pos_vel(PosVelCommand(start + 0.5, 1.0))
    speeds = []
    for _ in range(200):
        speeds.append(host.ask(MOTOR + Offset.POS_VEL, frame).velocity)
        host.wait(5)
    assert 0.9 < max(speeds) < 1.2
    assert host.refresh().position == pytest.approx(start + 0.5, abs=2e-3)


def test_pos_vel_carries_the_arm(host: Host) -> None:
    # Gravity pulls at joint 2 with some 20 Nm.
    host.write(Register.CTRL_MODE, ControlMode.POS_VEL, 2)
    host.special(Special.ENABLE, 2)
    start = host.refresh(2).position
    for _ in range(400):
        host.ask(2 + Offset.POS_VEL, encode_pos_vel(PosVelCommand(start, 1.0)), 2)
        host.wait(5)
    assert host.refresh(2).position == pytest.approx(start, abs=2e-3)


def test_velocity_mode(host: Host) -> None:
    host.write(Register.CTRL_MODE, ControlMode.VEL)
    host.special(Special.ENABLE)
    for _ in range(100):
        feedback = host.ask(MOTOR + Offset.VEL, encode_vel(0.8))
        host.wait(5)
    assert feedback.velocity == pytest.approx(0.8, abs=0.02)


def test_float_commands_that_are_no_numbers_are_ignored(host: Host) -> None:
    host.write(Register.CTRL_MODE, ControlMode.POS_VEL)
    host.special(Special.ENABLE)
    start = host.refresh().position
    for bad in (math.nan, math.inf, -math.inf):
        host.ask(MOTOR + Offset.POS_VEL, struct.pack("<ff", bad, 1.0))
        host.ask(MOTOR + Offset.POS_VEL, struct.pack("<ff", 1.0, bad))
        host.wait(10)
    assert host.refresh().position == pytest.approx(start, abs=0.01)


def test_gripper_closes_with_limited_force(host: Host) -> None:
    assert host.read(Register.CTRL_MODE, GRIPPER) == ControlMode.POS_FORCE
    host.special(Special.ENABLE, GRIPPER)
    drive = host.bench.drive(GRIPPER)
    opened = ROBOT.profile.gripper.motor_open
    for target in (opened, 0.0):
        for _ in range(400):
            frame = encode_pos_force(PosForceCommand(target, 5.0, 0.02))
            feedback = host.ask(GRIPPER + Offset.POS_FORCE, frame, GRIPPER)
            assert abs(drive.shaft.state()[2]) <= 0.02 * drive.ranges.tmax + 1e-9
            host.wait(5)
        assert feedback.position == pytest.approx(target, abs=0.05)


# --- watchdog and faults ----------------------------------------------------------------------------------------------


def test_watchdog_bites_after_its_time_and_not_before(host: Host) -> None:
    assert host.read(Register.TIMEOUT) == 1600
    host.special(Special.ENABLE)
    host.wait(79.9)
    assert host.drive.enabled
    host.wait(0.1)
    assert not host.drive.enabled
    assert host.refresh().status == Status.COMMUNICATION_LOST
    assert host.mit().status == Status.COMMUNICATION_LOST
    assert host.special(Special.ENABLE).status == Status.COMMUNICATION_LOST
    assert host.special(Special.DISABLE).status == Status.COMMUNICATION_LOST
    assert host.special(Special.CLEAR_ERROR).status == Status.DISABLED
    assert host.special(Special.ENABLE).status == Status.ENABLED


def test_watchdog_bites_at_its_own_time_within_one_long_advance(host: Host) -> None:
    host.special(Special.ENABLE)
    host.special(Special.ENABLE, 1)
    host.wait(40)
    host.mit(motor=1)
    stopped = {}
    for drive in host.bench.drives:
        drive.expire = lambda drive=drive, stop=drive.expire: (stopped.setdefault(drive.id, host.bench.now_ns), stop())
    host.wait(500)
    assert stopped == {MOTOR: 80 * MS, 1: 120 * MS}


@pytest.mark.parametrize("feed", ["mit", "refresh", "read"])
def test_any_frame_feeds_the_watchdog(host: Host, feed: str) -> None:
    host.special(Special.ENABLE)
    for _ in range(10):
        host.wait(70)
        {"mit": host.mit, "refresh": host.refresh, "read": lambda: host.read(Register.SN)}[feed]()
    assert host.drive.enabled


def test_frames_for_others_do_not_feed_it(host: Host) -> None:
    host.special(Special.ENABLE)
    for _ in range(4):
        host.wait(30)
        host.refresh(1)
    assert not host.drive.enabled


def test_watchdog_counts_only_while_enabled_and_zero_is_off(host: Host) -> None:
    host.wait(1000)
    assert host.refresh().status == Status.DISABLED
    host.write(Register.TIMEOUT, 0)
    host.special(Special.ENABLE)
    host.wait(5000)
    assert host.refresh().status == Status.ENABLED
    host.write(Register.TIMEOUT, 200)
    host.wait(10)
    assert host.refresh().status == Status.COMMUNICATION_LOST


def test_a_fault_takes_the_torque_away(host: Host) -> None:
    host.special(Special.ENABLE)
    host.mit(effort=2.0)
    host.wait(2)
    host.drive.fail(Status.OVER_CURRENT)
    host.wait(2)
    feedback = host.refresh()
    assert feedback.status == Status.OVER_CURRENT
    assert feedback.effort == pytest.approx(0.0, abs=0.014)


def test_it_gets_warm_and_switches_itself_off(host: Host) -> None:
    drive = host.bench.drive(GRIPPER)
    drive.preset(Register.TIMEOUT, 0)
    drive.preset(Register.TMAX, 0.05)
    host.special(Special.ENABLE, GRIPPER)
    for _ in range(3):
        host.ask(GRIPPER + Offset.POS_FORCE, encode_pos_force(PosForceCommand(-10.0, 5.0, 1.0)), GRIPPER)
        host.wait(10_000)
    feedback = host.refresh(GRIPPER)
    assert feedback.mosfet_temperature > 30
    assert feedback.rotor_temperature > 30
    drive.thermal.rotor = 101.0
    host.wait(200)
    assert host.refresh(GRIPPER).status == Status.ROTOR_OVER_TEMPERATURE


# --- registers --------------------------------------------------------------------------------------------------------


def test_every_register_can_be_read(host: Host) -> None:
    for register in REGISTERS:
        assert math.isfinite(host.read(register))
    assert host.replies(BROADCAST_ID, encode_register(MOTOR, RegisterCommand.READ, 200)) == []


def test_read_only_registers_keep_their_value(host: Host) -> None:
    serial = host.read(Register.SN)
    host.write(Register.SN, 1)
    assert host.read(Register.SN) == serial


def test_writes_go_to_ram_and_saving_to_flash(host: Host) -> None:
    host.write(Register.TIMEOUT, 4000)
    host.drive.power_up()
    assert host.read(Register.TIMEOUT) == 1600
    host.write(Register.TIMEOUT, 4000)
    (reply,) = host.save()
    assert reply.data == bytes.fromhex("0700AA0100000000")
    assert host.drive.memory.cycles == 1
    host.drive.power_down()
    host.drive.power_up()
    assert host.read(Register.TIMEOUT) == 4000


def test_nothing_is_saved_while_enabled(host: Host) -> None:
    host.special(Special.ENABLE)
    assert host.save() == []
    assert host.drive.memory.cycles == 0


def test_ids_act_at_once(host: Host) -> None:
    (reply,) = host.write(Register.ESC_ID, 0x2A)
    assert reply.arbitration_id == 0x17
    assert host.replies(MOTOR, bytes(8)) == []
    (reply,) = host.replies(0x2A, bytes(8))
    assert reply.arbitration_id == 0x17
    (reply,) = host.write(Register.MST_ID, 0x3A, 0x2A)
    assert reply.arbitration_id == 0x17
    (reply,) = host.replies(0x2A, bytes(8))
    assert reply.arbitration_id == 0x3A
    assert reply.data[0] & 0xF == 0xA


def test_two_motors_with_one_id_both_answer(host: Host) -> None:
    host.write(Register.ESC_ID, 6)
    assert [reply.arbitration_id for reply in host.replies(6, bytes(8))] == [0x16, 0x17]
    assert len(host.replies(BROADCAST_ID, encode_register(6, RegisterCommand.READ, Register.SN))) == 2


def test_full_scale_is_the_registers(host: Host) -> None:
    position = host.refresh().position
    host.write(Register.PMAX, 3.0)
    assert host.refresh().position == pytest.approx(position, abs=3e-4)


def test_bit_rate_decides_how_it_answers() -> None:
    for fd, code in ((True, 9), (False, 4)):
        host = Host(fd=fd)
        assert host.read(Register.CAN_BR) == code
        assert host.replies(MOTOR, bytes(8))[0].fd is fd
        # The reply to the change still goes the old way.
        assert host.write(Register.CAN_BR, 13 - code)[0].fd is fd
        assert host.replies(MOTOR, bytes(8))[0].fd is not fd


def test_a_drive_at_another_nominal_bit_rate_hears_nothing(host: Host) -> None:
    host.write(Register.CAN_BR, 3)
    assert host.replies(MOTOR, bytes(8)) == []
    assert host.replies(BROADCAST_ID, encode_register(MOTOR, RegisterCommand.READ, 9)) == []


def test_a_stored_rate_above_5m_falls_back_at_power_up(host: Host) -> None:
    host.write(Register.CAN_BR, 10)
    host.save()
    host.drive.power_up()
    assert host.read(Register.CAN_BR) == 4


# --- zero and wake-up -------------------------------------------------------------------------------------------------


def test_zero_is_here_and_stays_over_power(host: Host) -> None:
    assert abs(host.refresh().position) > 0.1
    assert host.special(Special.SET_ZERO).position == pytest.approx(0.0, abs=2e-4)
    assert host.drive.memory.cycles == 1
    host.drive.power_up()
    assert host.refresh().position == pytest.approx(0.0, abs=2e-4)


@pytest.mark.parametrize("turns", [-1, 0, 1])
def test_it_wakes_within_half_a_turn_of_zero(host: Host, turns: int) -> None:
    state = host.drive.shaft.state

    class Far:
        def __getattr__(self, name):
            return lambda *arguments: None

        def state(self):
            return (state()[0] + turns * 2 * math.pi, 0.0, 0.0)

    true = state()[0]
    host.drive.shaft = Far()
    assert host.refresh().position == pytest.approx(true + turns * 2 * math.pi, abs=4e-4)
    host.drive.power_up()
    assert host.refresh().position == pytest.approx(true, abs=4e-4)


def test_the_law_holds_where_it_woke() -> None:
    host = Host()
    host.special(Special.ENABLE, GRIPPER)
    for _ in range(300):
        frame = encode_pos_force(PosForceCommand(4.0, 5.0, 0.04))
        host.ask(GRIPPER + Offset.POS_FORCE, frame, GRIPPER)
        host.wait(5)
    host.bench.drive(GRIPPER).power_up()
    folded = host.refresh(GRIPPER).position
    assert folded == pytest.approx(4.0 - 2 * math.pi, abs=0.01)
    host.special(Special.ENABLE, GRIPPER)
    for _ in range(100):
        host.ask(GRIPPER + Offset.POS_FORCE, encode_pos_force(PosForceCommand(folded, 5.0, 0.04)), GRIPPER)
        host.wait(5)
    assert host.refresh(GRIPPER).position == pytest.approx(folded, abs=0.01)


# --- imperfections of the profile -------------------------------------------------------------------------------------


def test_dead_time_holds_motion_commands_back() -> None:
    host = Host(load_robot("panda", ["twin.delay_s=0.02"]))
    host.special(Special.ENABLE)
    host.mit(effort=2.0)
    host.wait(19)
    host.refresh()
    assert host.drive.shaft.state()[2] == 0.0
    host.wait(2)
    assert host.drive.shaft.state()[2] == pytest.approx(2.0, abs=0.02)


def test_what_was_under_way_at_a_stop_never_acts() -> None:
    host = Host(load_robot("panda", ["twin.delay_s=0.02"]))
    host.special(Special.ENABLE)
    host.mit(effort=2.0)
    host.special(Special.DISABLE)
    host.special(Special.ENABLE)
    host.wait(40)
    assert host.drive.shaft.state()[2] == 0.0


def test_the_first_command_does_not_kick_through_the_lag() -> None:
    host = Host(load_robot("panda", ["twin.lag_s=0.02"]))
    host.special(Special.ENABLE)
    position, _, effort = host.drive.shaft.state()
    for _ in range(50):
        host.mit(position, 0.0, 50.0, 1.0, effort)
        host.wait(2)
        assert host.drive.shaft.state()[0] == pytest.approx(position, abs=0.02)


def test_drives_that_are_off_leave_the_arm_where_it_lies() -> None:
    for name in ("panda", "openarm"):
        host = Host(load_robot(name))
        before = host.bench.plant.truth().position
        host.wait(2000)
        assert host.bench.plant.truth().position == pytest.approx(before, abs=2e-3)


def test_noise_is_seeded() -> None:
    def run(seed: int) -> list:
        host = Host(load_robot("panda", ["twin.noise_position=0.01"]), seed=seed)
        return [host.refresh().position for _ in range(20)]

    assert run(1) == run(1)
    assert run(1) != run(2)
    assert len(set(run(1))) > 5
