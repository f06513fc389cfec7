"""The arm on emulated drives: what goes out in a cycle, what comes back, and who stops whom."""

import numpy as np
import pytest

from robotctl.hal.backend import open_backend
from robotctl.hal.can.cia402 import objects as od
from robotctl.hal.can.cia402.codec import (
    EMERGENCY,
    SYNC_ID,
    Emergency,
    Mode,
    Nmt,
    Service,
    decode_feed_forward,
    decode_setpoint,
    encode_emergency,
)
from robotctl.hal.can.cia402.machine import State, Word
from robotctl.hal.clock import VirtualClock
from robotctl.hal.errors import ConfigError, DriveError
from robotctl.hal.robot import load_robot
from robotctl.hal.types import Command, CommandMode
from robotctl.sim.motors.trouble import Drop, Failure, Mute, PowerCut


def words(desk, node: int = 1) -> list[int]:
    return [decode_setpoint(data).controlword for found, data in desk.sent if found == Service.RPDO1 + node]


# -- a cycle -----------------------------------------------------------------------------------------------------------


def test_a_cycle_is_two_frames_for_each_drive_and_one_sync_at_the_end(desk):
    desk.enable()
    desk.sent.clear()
    desk.arm.write(desk.hold())
    ids = [found for found, _ in desk.sent if found != Service.HEARTBEAT + 127]
    assert ids == [base + node for node in range(1, 8) for base in (0x200, 0x300)] + [SYNC_ID]


def test_a_position_is_tracked_with_its_velocity_and_torque(desk):
    desk.enable()
    desk.sent.clear()
    velocity = np.array([0.1, -0.2, 0.0, 0.0, 0.0, 0.0, 0.0])
    desk.arm.write(desk.hold()._replace(velocity=velocity))
    frames = dict(desk.sent)
    setpoint, ahead = decode_setpoint(frames[0x202]), decode_feed_forward(frames[0x302])
    counts = 131072 * 100 / (2 * np.pi)
    # joint2 turns the other way round
    assert setpoint == (Word.ENABLE_OPERATION, Mode.POSITION, round(0.3 * counts))
    assert ahead.velocity == round(0.2 * counts)
    assert ahead.torque == round(-desk.hold().effort[1] / (0.35 * 100) * 1000)


@pytest.mark.parametrize(("mode", "wire"), [(CommandMode.DAMP, Mode.VELOCITY), (CommandMode.EFFORT, Mode.TORQUE)])
def test_other_commands_take_other_modes_and_say_no_velocity(desk, mode: CommandMode, wire: Mode):
    desk.enable()
    desk.sent.clear()
    desk.arm.write(desk.hold(mode)._replace(velocity=desk.rest + 1.0, position=desk.home + 1.0))
    frames = dict(desk.sent)
    assert {decode_setpoint(frames[0x200 + node]).mode for node in range(1, 8)} == {wire}
    assert {decode_feed_forward(frames[0x300 + node]).velocity for node in range(1, 8)} == {0}
    assert desk.drive(1).dictionary[od.MODE_DISPLAY] == wire


def test_what_the_wire_cannot_say_is_clipped_and_told(desk):
    desk.enable()
    sent = desk.arm.write(desk.hold()._replace(velocity=desk.rest + 1e6))
    assert "clipped to the wire's range: joint1" in sent.altered
    assert desk.arm.write(desk.hold()).altered == ""


def test_where_the_last_frame_does_not_leave_nothing_takes_effect(desk):
    desk.enable()
    send, count = desk.bus.send, [0]

    def full(message, timeout=None):
        count[0] += 1
        if count[0] > 5:
            raise OSError(105, "No buffer space available")
        send(message, timeout)

    desk.arm._transport._send = full
    before = desk.drive(1).dictionary[od.TARGET_POSITION]
    sent = desk.arm.write(desk.hold()._replace(position=desk.home + 0.01))
    assert not sent.delivered
    assert "queue is full" in sent.altered
    assert desk.drive(1).dictionary[od.TARGET_POSITION] == before


# -- on and off --------------------------------------------------------------------------------------------------------


def test_torque_comes_state_by_state_and_where_the_joints_are(desk):
    desk.enable()
    led = [word for word in words(desk) if word]
    assert led == [Word.SHUTDOWN, Word.SWITCH_ON, Word.ENABLE_OPERATION]
    first = [decode_setpoint(data) for found, data in desk.sent if found == 0x201][-1]
    assert first.position == pytest.approx(0, abs=2)
    assert desk.drive(1).nmt == Nmt.OPERATIONAL


def test_a_drive_that_does_not_come_on_takes_the_others_with_it(desk):
    desk.arm.verify()
    drive = desk.drive(4)
    command = drive._command
    drive._command = lambda word, rising: command(word & ~0x08, rising=rising)  # its enable input is open
    with pytest.raises(DriveError, match=r"joint4.*did not come on within 1 s, it is in state SWITCHED ON"):
        desk.arm.enable()
    assert not any(other.enabled for other in desk.bench.drives)


def test_a_fault_while_it_is_enabled_is_told_by_name(desk):
    desk.arm.verify()
    drive = desk.drive(4)
    go = drive._go
    drive._go = lambda state: drive.fail(0x7121) if state is State.ENABLED else go(state)
    with pytest.raises(DriveError, match="reports MOTOR_BLOCKED when it is enabled"):
        desk.arm.enable()
    assert not any(other.enabled for other in desk.bench.drives)


def test_a_drive_that_went_off_by_itself_is_told_and_not_led_back(desk):
    desk.enable()
    desk.drive(2)._go(State.OFF)
    desk.sent.clear()
    desk.tick(20, desk.hold())
    assert not desk.arm.read().enabled
    assert "joint2 (SWITCH ON DISABLED)" in desk.arm.write(desk.hold()).altered
    assert set(words(desk, 2)[1:]) == {Word.DISABLE_VOLTAGE}


def test_a_drive_that_never_confirms_is_named_and_the_others_are_off(desk):
    desk.enable()
    desk.bench.trouble.add(Mute(motor_id=6))
    with pytest.raises(DriveError, match=r"joint6.*did not confirm 10 times that it is off"):
        desk.arm.disable()
    assert not any(drive.enabled for drive in desk.bench.drives)


def test_a_drive_that_has_restarted_is_off_and_says_so_when_asked(desk):
    desk.enable()
    cut = PowerCut(motor_id=6)
    desk.bench.trouble.add(cut)
    desk.tick()
    desk.bench.trouble.remove(cut)
    desk.arm.disable()


# -- faults ------------------------------------------------------------------------------------------------------------


def test_a_fault_is_told_with_its_code_and_what_to_do(desk):
    desk.enable()
    desk.bench.trouble.add(Failure(motor_id=3, status=0x3220))
    sample = desk.tick(2, desk.hold())
    (fault,) = sample.faults
    assert (fault.joint, fault.code, fault.name) == ("joint3", 0x3220, "UNDER_VOLTAGE")
    assert "supply" in fault.hint
    assert not sample.enabled


def test_an_emergency_without_a_fault_state_is_told_until_its_cause_has_gone(desk):
    desk.enable()
    for code, expected in ((0x8120, ("CAN_PASSIVE",)), (0, ())):
        desk.bench.say(desk.drive(5), 0x085, encode_emergency(Emergency(code, 0x11, bytes(5))))
        assert tuple(fault.name for fault in desk.tick(1, desk.hold()).faults) == expected


def test_in_the_command_path_nothing_is_cleared(desk):
    desk.enable()
    desk.bench.trouble.add(Failure(motor_id=3))
    desk.tick(50, desk.hold())
    desk.arm.disable()
    with pytest.raises(DriveError, match="reports CONTINUOUS_OVER_CURRENT"):
        desk.arm.enable()
    with pytest.raises(DriveError):
        desk.arm.verify()
    assert desk.drive(3).state is State.FAULT
    assert not any(word & Word.FAULT_RESET for node in range(1, 8) for word in words(desk, node))


@pytest.mark.parametrize("data", [bytes(7), bytes(0), b"\x34\x02" + bytes(6)], ids=["short", "empty", "no state"])
def test_status_without_sense_is_counted_and_not_used(desk, data: bytes):
    desk.enable()
    before, rejected = desk.arm.read(), desk.arm._transport.rejected
    desk.bench.say(desk.drive(2), 0x182, data)
    sample = desk.arm.read()
    assert sample.rejected == rejected + 1
    assert (sample.position == before.position).all()
    assert sample.enabled


@pytest.mark.parametrize(("service", "size"), [(0x280, 4), (0x080, EMERGENCY.size - 1), (0x700, 2)])
def test_other_frames_of_a_wrong_length_are_counted(desk, service: int, size: int):
    desk.enable()
    rejected = desk.arm._transport.rejected
    desk.bench.say(desk.drive(2), service + 2, bytes(size))
    assert desk.tick(1, desk.hold()).rejected == rejected + 1


# -- heartbeats --------------------------------------------------------------------------------------------------------


def test_a_host_that_falls_silent_loses_the_drives_within_their_time(desk):
    desk.enable()
    desk.tick(20, desk.hold())
    last = desk.clock.now_ns()
    while desk.drive(1).enabled:
        desk.clock.sleep_until(desk.clock.now_ns() + 1_000_000)
        desk.bench.advance(desk.clock.now_ns())
    assert 0.05 <= (desk.clock.now_ns() - last) * 1e-9 <= 0.1
    desk.bench.advance(desk.clock.now_ns() + 200_000_000)
    assert all(drive.state is State.OFF for drive in desk.bench.drives)
    assert {drive.nmt for drive in desk.bench.drives} == {Nmt.PRE_OPERATIONAL}
    faults = desk.arm.read().faults
    assert {fault.name for fault in faults} == {"HEARTBEAT_LOST"}


def test_a_loop_that_reads_but_does_not_command_is_a_dead_host_too(desk):
    desk.enable()
    desk.tick(desk.seconds(0.2))
    assert not any(drive.enabled for drive in desk.bench.drives)


def test_the_host_s_heartbeat_goes_on_while_the_drives_are_off(desk):
    desk.arm.verify()
    desk.tick(desk.seconds(1.0))
    assert desk.arm.read().faults == ()
    beats = [data for found, data in desk.sent if found == Service.HEARTBEAT + 127]
    assert 40 <= len(beats) <= 60
    assert set(beats) == {b"\x05"}


def test_a_host_that_was_silent_while_the_drives_were_off_starts_them_again(desk):
    desk.arm.verify()
    desk.tick(20)
    desk.clock.sleep_until(desk.clock.now_ns() + 500_000_000)
    desk.tick(30)
    assert {drive.nmt for drive in desk.bench.drives} == {Nmt.PRE_OPERATIONAL}
    assert {fault.name for fault in desk.arm.read().faults} == {"NOT_OPERATIONAL"}
    desk.arm.enable()
    assert desk.tick(30, desk.hold()).faults == ()


def test_a_drive_whose_heartbeat_is_lost_is_told(desk):
    desk.enable()
    desk.bench.trouble.add(Mute(motor_id=2))
    sample = desk.tick(desk.seconds(0.5), desk.hold())
    assert [fault.name for fault in sample.faults] == ["DRIVE_LOST"]
    assert sample.stamp_ns - sample.joint_stamp_ns[1] > 400_000_000


def test_lost_frames_are_counted_and_survived(desk):
    desk.enable()
    desk.bench.trouble.add(Drop(probability=0.05))
    assert desk.tick(desk.seconds(1.0), desk.hold()).enabled
    assert desk.arm.bus_statistics()["missed_replies"] > 10


# -- configuration -----------------------------------------------------------------------------------------------------


def test_a_bus_that_is_too_slow_is_refused():
    arm = open_backend("can", load_robot("xarm7", ["can.bitrate=500000"]), VirtualClock()).arm
    with pytest.raises(ConfigError, match=r"a load of 137%\n  try: --set servo_hz=131$"):
        arm.connect()
    assert arm.channel is None


def test_only_damiao_drives_may_be_on_several_buses():
    with pytest.raises(ConfigError, match=r"(?s)CiA 402 drives on a robot with 2 buses.*one bus"):
        open_backend("can", load_robot("xarm7", ["joints.0.drive.bus=1"]), VirtualClock())


def test_joints_of_one_arm_speak_one_protocol():
    robot = load_robot(
        "xarm7", ["joints.0.drive={id: 1, reply_id: 17, motor: DM8009, gear: 1.0}", "joints.0.torque=5.0"]
    )
    with pytest.raises(ConfigError, match="on different protocols"):
        open_backend("can", robot, VirtualClock())


def test_a_gripper_on_such_a_drive_is_refused():
    wiring = "{protocol: cia402, id: 8, resolution: 65536, rated_torque: 0.1}"
    with pytest.raises(ConfigError, match="no gripper on a CiA 402 drive"):
        open_backend("can", load_robot("panda", [f"gripper.drive={wiring}"]), VirtualClock())


def test_effort_is_remembered_while_the_drives_are_off(desk):
    desk.arm.verify()
    assert desk.arm.write(Command(*desk.hold())).altered == "drives are off"
