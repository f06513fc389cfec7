"""The life of an arm: what goes out, when, and what comes back."""

import errno

import can
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from robotctl.hal.can.channel import Channel
from robotctl.hal.can.damiao.codec import BROADCAST_ID, MitCommand, Special, encode_mit, is_feedback
from robotctl.hal.can.problems import DrivesError
from robotctl.hal.errors import BusError, ConfigError, DriveError, HardwareError
from robotctl.hal.types import Command, CommandMode

N = 7


def command(bench, mode=CommandMode.TRACK, position=None, effort=0.0):
    position = bench.arm.read().position if position is None else position
    return Command(mode, np.array(position), np.zeros(N), np.full(N, effort))


def test_connect_sends_nothing(bench):
    bench.arm.connect()
    bench.arm.connect()
    bench.arm.read()
    assert bench.bus.sent == []


def test_joint_angles_are_nan_with_stamp_zero_before_anything_was_heard(bench):
    bench.arm.connect()
    sample = bench.arm.read()
    assert np.isnan(sample.position).all()
    assert (sample.joint_stamp_ns == 0).all()


def test_verify_enables_nothing_and_writes_nothing(bench):
    bench.ready()
    assert set(bench.ids_sent()) == {BROADCAST_ID}
    assert all(motor.status == 0 and not motor.written for motor in bench.motors)


def test_verify_tells_what_the_drives_are(bench):
    bench.ready()
    identity = bench.arm.identities["panda_joint3"]
    assert (identity.motor_id, identity.reply_id, identity.software, identity.serial) == (3, 0x13, 5013, 1003)
    assert identity.timeout_s == pytest.approx(0.1)


def test_read_maps_motor_to_joint(bench):
    bench.ready()
    assert bench.arm.read().position == pytest.approx(bench.robot.profile.home, abs=4e-4)


def test_state_flows_while_the_drives_are_off(bench):
    bench.ready()
    for _ in range(5):
        bench.clock.sleep_until(bench.clock.now_ns() + 4_000_000)
        sample = bench.arm.read()
    assert (sample.joint_stamp_ns == bench.clock.now_ns()).all()
    assert not sample.enabled


def test_enable_needs_verify(bench):
    bench.arm.connect()
    with pytest.raises(HardwareError, match="not verified"):
        bench.arm.enable()


def test_enable_ends_holding_the_measured_pose(bench):
    bench.running()
    assert bench.arm.read().enabled
    for motor in bench.motors:
        assert motor.commands[-1].position == pytest.approx(motor.position, abs=4e-4)
        assert motor.commands[-1].velocity == pytest.approx(0.0, abs=0.02)
        assert motor.commands[-1].kp > 0
    assert bench.gripper.commands[-1].position == pytest.approx(2.0, abs=4e-4)


def test_enable_holds_with_the_effort_of_the_command_before(bench):
    bench.ready()
    assert bench.arm.write(command(bench, effort=3.0)).altered == "drives are off"
    bench.arm.enable()
    assert bench.motors[1].commands[-1].effort == pytest.approx(-3.0, abs=0.06)


def test_enable_is_idempotent(bench):
    bench.running()
    before = bench.specials()
    bench.arm.enable()
    assert bench.specials() == before


def test_enable_never_clears_a_fault(bench):
    bench.ready()
    bench.motors[2].status = 0xE
    with pytest.raises(DriveError, match=r"panda_joint3.*OVERLOAD"):
        bench.arm.enable()
    assert bench.specials() == []


def test_a_drive_that_does_not_enable_leaves_none_enabled(bench):
    bench.ready()
    bench.motors[4].refuses_enable = True
    with pytest.raises(DriveError, match=r"panda_joint5.*did not enable"):
        bench.arm.enable()
    assert all(motor.status == 0 for motor in [*bench.motors, bench.gripper])


def test_a_drive_that_woke_up_again_a_turn_off_is_not_enabled(bench):
    bench.ready()
    bench.motors[0].position += 2 * np.pi
    with pytest.raises(DriveError, match="outside its joint's range"):
        bench.arm.enable()


def test_lost_replies_during_enable_are_retried(bench):
    bench.ready()
    for motor in bench.motors:
        motor.drop_next = 1
    bench.arm.enable()
    assert bench.arm.read().enabled


def test_frames_are_those_of_the_codec(bench):
    bench.running()
    rng = np.random.default_rng(1)
    limits = bench.robot.limits
    for _ in range(200):
        q = rng.uniform(limits.lower, limits.upper)
        dq = rng.uniform(-limits.velocity, limits.velocity)
        torque = rng.uniform(-limits.torque, limits.torque)
        bench.bus.sent.clear()
        sent = bench.arm.write(Command(CommandMode.TRACK, q, dq, torque))
        assert sent.altered == ""
        for joint, motor, message, *values in zip(
            bench.robot.profile.joints, bench.motors, bench.bus.sent, q, dq, torque, strict=True
        ):
            s = joint.drive.sign
            wanted = MitCommand(
                s * (values[0] - joint.drive.offset), s * values[1], joint.gains.kp, joint.gains.kd, s * values[2]
            )
            word = int.from_bytes(message.data, "big")
            expected = int.from_bytes(encode_mit(wanted, motor.ranges), "big")
            for shift, mask in ((48, 0xFFFF), (36, 0xFFF), (24, 0xFFF), (12, 0xFFF), (0, 0xFFF)):
                assert abs((word >> shift & mask) - (expected >> shift & mask)) <= 1
            assert message.is_fd
            assert message.bitrate_switch


def test_special_and_register_frames_are_classic(bench):
    bench.running()
    bench.arm.disable()
    quiet = [m for m in bench.bus.sent if m.arbitration_id == BROADCAST_ID or m.data[:7] == b"\xff" * 7]
    assert quiet
    assert not any(m.is_fd for m in quiet)


@pytest.mark.parametrize(
    ("mode", "stiff", "damped"), [(CommandMode.EFFORT, False, False), (CommandMode.DAMP, False, True)]
)
def test_modes_without_stiffness(bench, mode, stiff, damped):
    bench.running()
    bench.arm.write(command(bench, mode, effort=2.0))
    for motor in bench.motors:
        assert (motor.commands[-1].kp > 0) == stiff
        assert (motor.commands[-1].kd > 0) == damped
        assert abs(motor.commands[-1].effort) == pytest.approx(2.0, abs=0.06)


def test_clipping_by_the_wire_is_told(bench):
    bench.running()
    asked = command(bench, effort=50.0)
    sent = bench.arm.write(asked)
    assert "clipped" in sent.altered
    assert "panda_joint5" in sent.altered
    assert "panda_joint1" not in sent.altered
    assert sent.command.effort == pytest.approx([50.0] * 4 + [28.0] * 3, abs=0.06)
    assert (asked.effort == 50.0).all()
    assert bench.arm.write(command(bench)).altered == ""


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e308])
@pytest.mark.parametrize("index", range(3))
def test_values_that_are_not_finite_are_not_sent(bench, bad, index):
    bench.running()
    bench.bus.sent.clear()
    arrays = [np.zeros(N), np.zeros(N), np.zeros(N)]
    arrays[0] += bench.arm.read().position
    arrays[index][3] = bad
    sent = bench.arm.write(Command(CommandMode.TRACK, *arrays))
    assert sent.altered
    if bad != 1e308:
        assert bench.bus.sent == []


def test_the_inspector_keeps_frames_back(bench):
    class Refusing:
        def frames(self, frames):
            return f"{len(frames)} refused"

    bench.running()
    bench.arm.inspect_with(Refusing())
    bench.bus.sent.clear()
    sent = bench.arm.write(command(bench))
    assert (sent.altered, sent.delivered) == ("not sent: 7 refused", False)
    assert bench.bus.sent == []
    assert bench.arm.bus_statistics()["withheld"] == 7


def test_a_mute_joint_keeps_its_stamp_and_is_counted(bench):
    bench.running()
    bench.motors[3].mute = True
    muted = bench.clock.now_ns()
    for _ in range(5):
        bench.clock.sleep_until(bench.clock.now_ns() + 2_000_000)
        bench.arm.write(command(bench))
    sample = bench.arm.read()
    assert sample.joint_stamp_ns[3] == muted
    assert (np.delete(sample.joint_stamp_ns, 3) == bench.clock.now_ns()).all()
    statistics = bench.arm.bus_statistics()
    assert statistics["missed_replies"] == 4
    assert statistics["missed_by_joint"]["panda_joint4"] == 4


@pytest.mark.parametrize(("status", "name"), [(0xD, "COMMUNICATION_LOST"), (0xE, "OVERLOAD"), (0x7, "UNKNOWN_7")])
def test_faults_show_in_the_sample(bench, status, name):
    bench.running()
    bench.motors[6].status = status
    sent = bench.arm.write(command(bench))
    assert f"panda_joint7 ({name})" in sent.altered
    sample = bench.arm.read()
    (fault,) = sample.faults
    assert (fault.joint, fault.code, fault.name) == ("panda_joint7", status, name)
    assert fault.hint
    assert not sample.enabled


def test_disable_is_resent_until_confirmed(bench):
    bench.running()
    bench.motors[5].drop_next = 4
    bench.arm.disable()
    assert all(motor.status == 0 for motor in [*bench.motors, bench.gripper])
    mine = [m for m in bench.bus.sent if m.arbitration_id == 6 and m.data[7] == Special.DISABLE]
    assert len(mine) == 5


def test_a_disable_that_is_never_confirmed_names_the_joint(bench):
    bench.running()
    bench.motors[5].stubborn = True
    with pytest.raises(DriveError, match=r"panda_joint6.*did not confirm 10"):
        bench.arm.disable()
    assert sum(motor.status for motor in bench.motors) == 1
    with pytest.raises(HardwareError, match="not verified"):
        bench.arm.enable()
    bench.motors[5].stubborn = False


def test_clearing_faults_enables_nothing(bench):
    bench.running()
    bench.motors[0].status = bench.motors[1].status = 0xD
    bench.motors[1].sticky_fault = True
    specials = len(bench.specials())
    with pytest.raises(DriveError, match=r"panda_joint2.*COMMUNICATION_LOST"):
        bench.arm.clear_faults()
    assert bench.motors[0].status == 0
    assert set(bench.specials()[specials:]) == {Special.CLEAR_ERROR}


def test_hold_commands_the_measured_pose(bench):
    bench.running()
    bench.motors[0].position += 0.1
    bench.arm.write(command(bench, effort=1.0))
    bench.arm.hold()
    assert bench.motors[0].commands[-1].position == pytest.approx(bench.motors[0].position, abs=4e-4)
    assert bench.motors[0].commands[-1].effort == pytest.approx(1.0, abs=0.06)


def test_close_is_idempotent_and_shuts_the_bus_down(bench):
    bench.running()
    sent = len(bench.bus.sent)
    bench.arm.close()
    bench.arm.close()
    assert bench.bus.shutdowns == 1
    assert len(bench.bus.sent) == sent
    with pytest.raises(HardwareError, match="not connected"):
        bench.arm.read()


def test_bus_loss_reaches_the_loop(bench):
    bench.running()
    bench.bus.send_error = can.CanOperationError("Failed to transmit: No such device", errno.ENODEV)
    with pytest.raises(BusError):
        bench.arm.write(command(bench))


def test_a_full_queue_is_told_and_not_insisted_on(bench):
    bench.running()
    bench.bus.send_error = can.CanOperationError("Transmit buffer full")
    assert "transmit queue is full" in bench.arm.write(command(bench)).altered
    assert bench.arm.bus_statistics()["send_failures"] == 1


def test_bus_off_is_a_fault(bench):
    bench.running()
    bench.bus.inject(0x40, bytes(8), is_error_frame=True)
    assert "BUS_OFF" in [fault.name for fault in bench.arm.read().faults]


def test_a_profile_without_can_is_refused(bench):
    from robotctl.hal.can.backend import open_can
    from robotctl.hal.robot import Robot

    profile = bench.robot.profile.model_copy(update={"can": None})
    robot = Robot(profile, bench.robot.description, bench.robot.limits, bench.robot.source)
    with pytest.raises(ConfigError, match="no `can` section"):
        open_can(robot, bench.clock)


def test_gains_beyond_the_wire_are_refused(bench):
    from robotctl.hal.can.damiao.arm import DamiaoArm
    from robotctl.hal.robot import Robot

    joints = list(bench.robot.profile.joints)
    gains = joints[0].gains.model_copy(update={"kd": 6.0})
    joints[0] = joints[0].model_copy(update={"gains": gains})
    profile = bench.robot.profile.model_copy(update={"joints": joints})
    with pytest.raises(ConfigError, match="panda_joint1: the drive takes kp up to 500 and kd up to 5"):
        DamiaoArm(Robot(profile, bench.robot.description, bench.robot.limits, bench.robot.source), bench.clock, "x")


def test_gripper_follows_its_command_every_ten_milliseconds(bench):
    bench.running()
    gripper = bench.arm.gripper
    gripper.command(0.02, 20.0)
    before = len(bench.gripper.commands)
    for _ in range(50):
        bench.clock.sleep_until(bench.clock.now_ns() + 2_000_000)
        gripper.step()
    assert len(bench.gripper.commands) - before == pytest.approx(10, abs=1)
    last = bench.gripper.commands[-1]
    assert last.position == pytest.approx(1.0)
    assert last.current == pytest.approx(20.0 * 0.08 / 4.0 / 10.0, abs=1e-4)
    assert gripper.read().width == pytest.approx(0.04, abs=1e-4)


@pytest.mark.parametrize(
    ("width", "force"), [(-0.01, 10), (0.09, 10), (np.nan, 10), (0.01, 0), (0.01, 99), (0.01, np.nan)]
)
def test_gripper_refuses_what_it_cannot_do(bench, width, force):
    bench.running()
    with pytest.raises(ValueError):
        bench.arm.gripper.command(width, force)


def test_gripper_is_silent_while_off(bench):
    bench.ready()
    bench.arm.gripper.command(0.02, 20.0)
    bench.arm.gripper.step()
    assert bench.gripper.commands == []


@settings(max_examples=300, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    arbitration_id=st.one_of(st.integers(0, 0x7FF), st.integers(0x11, 0x18)),
    data=st.one_of(st.binary(max_size=64), st.binary(min_size=8, max_size=8)),
    flags=st.sampled_from([{}, {"is_fd": True}, {"is_remote_frame": True}, {"is_error_frame": True}]),
    extended=st.sampled_from([False, False, False, True]),
)
def test_random_frames_never_raise_nor_refresh_a_stamp_unless_valid(bench, arbitration_id, data, flags, extended):
    if not bench.bus.sent:
        bench.running()
    before = bench.arm.read()
    bench.clock.sleep_until(bench.clock.now_ns() + 1000)
    bench.bus.queue.append(can.Message(arbitration_id=arbitration_id, is_extended_id=extended, data=data, **flags))
    after = bench.arm.read()
    feedback = (
        not extended
        and not (flags.get("is_remote_frame") or flags.get("is_error_frame"))
        and 0x11 <= arbitration_id <= 0x17
        and is_feedback(data, arbitration_id - 0x10)
    )
    heard = [arbitration_id - 0x11] if feedback else []
    assert list(np.flatnonzero(after.joint_stamp_ns != before.joint_stamp_ns)) == heard
    others = np.delete(np.arange(N), heard)
    assert (after.position[others] == before.position[others]).all()


def test_all_problems_are_one_error(bench):
    bench.motors[0].mute = True
    bench.motors[3].status = 0xB
    bench.motors[5].registers[9] = 0
    bench.arm.connect()
    with pytest.raises(DrivesError) as caught:
        bench.arm.verify()
    assert [problem.motor_id for problem in caught.value.problems] == [1, 4, 6]


def test_lockstep_is_refused_where_the_drives_live_in_real_time(bench, monkeypatch):
    channel = Channel(bench.bus, fd=True, simulated=False)
    monkeypatch.setattr("robotctl.hal.can.arm.open_channel", lambda name, robot, clock: channel)
    with pytest.raises(ConfigError, match="would move too fast") as caught:
        bench.arm.connect()
    assert "--fast" in str(caught.value)
    assert bench.bus.sent == []
    with pytest.raises(HardwareError, match="not connected"):
        bench.arm.verify()
