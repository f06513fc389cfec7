"""Every refusal of bring-up, and what it tells the person who has to fix it."""

import numpy as np
import pytest

from robotctl.hal.can.damiao.registers import Register
from robotctl.hal.can.damiao.verification import plausible_turns
from robotctl.hal.can.problems import DrivesError
from robotctl.hal.errors import DriveError


def refusal(bench) -> str:
    bench.arm.connect()
    with pytest.raises(DriveError) as caught:
        bench.arm.verify()
    return str(caught.value)


def test_a_silent_drive(bench):
    bench.motors[2].mute = True
    text = refusal(bench)
    for part in ("panda_joint3", "0x03", "does not answer", "power", "ground", "termination", "CAN FD", "bit rate"):
        assert part in text


def test_a_drive_that_loses_four_of_five_replies_is_not_silent(bench):
    bench.motors[2].drop_next = 4
    bench.ready()


def test_a_drive_on_another_reply_id(bench):
    bench.motors[2].reply_id = 0x23
    text = refusal(bench)
    assert "answers on id 0x23, the profile says 0x13" in text
    assert "MST_ID" in text


def test_two_motors_with_one_id_and_one_reply_id(bench, scripted_motor):
    bench.bus.motors.append(scripted_motor(3, 0x13, bench.motors[2].ranges))
    assert "2 motors answer to id 0x03" in refusal(bench)


def test_two_motors_with_one_id_and_different_reply_ids(bench, scripted_motor):
    bench.bus.motors.append(scripted_motor(3, 0x33, bench.motors[2].ranges))
    text = refusal(bench)
    assert "2 motors answer to id 0x03" in text
    assert "0x33" in text


def test_one_frame_sent_twice_is_no_second_motor(bench):
    motor, original = bench.motors[2], bench.motors[2].on_frame
    calls = []

    def twice_at_first(arbitration_id, data):
        reply = original(arbitration_id, data)
        if reply is not None:
            calls.append(reply)
            motor.copies = 2 if len(calls) == 1 else 1
        return reply

    motor.on_frame = twice_at_first
    bench.ready()


def test_ids_that_a_drive_says_of_itself(bench):
    bench.motors[0].registers[Register.MST_ID] = 0x12
    assert "says its ids are 0x01 and 0x12" in refusal(bench)


def test_ranges_are_told_with_both_values(bench):
    bench.motors[4].registers[Register.VMAX] = 8.0
    text = refusal(bench)
    assert "12.5 / 8 / 28" in text
    assert "a DM4340 has 12.5 / 10 / 28" in text


def test_a_drive_without_watchdog(bench):
    bench.motors[1].registers[Register.TIMEOUT] = 0
    text = refusal(bench)
    assert "drive has no watchdog" in text
    assert "register 9" in text
    assert "2000" in text


def test_a_watchdog_that_waits_too_long(bench):
    bench.motors[1].registers[Register.TIMEOUT] = 8000
    assert "waits 400 ms, 100 ms are allowed" in refusal(bench)


def test_a_fault_is_named_with_its_remedy_and_not_cleared(bench):
    bench.motors[1].status = 0x9
    text = refusal(bench)
    assert "UNDER_VOLTAGE" in text
    assert "supply" in text
    assert bench.motors[1].status == 0x9


def test_another_control_mode_is_set_in_ram_while_disabled(bench):
    bench.motors[1].registers[Register.CTRL_MODE] = 2
    bench.ready()
    assert bench.motors[1].written == [(Register.CTRL_MODE, 1.0)]
    assert bench.arm.warnings == ["panda_joint2: control mode was 2, set to MIT in RAM"]


def test_another_control_mode_is_refused_while_enabled(bench):
    bench.motors[1].registers[Register.CTRL_MODE] = 2
    bench.motors[1].status = 1
    assert "control mode is 2, needed is 1 (MIT), and the drive is ENABLED" in refusal(bench)
    assert bench.motors[1].written == []


def test_a_control_mode_that_does_not_stay(bench):
    bench.motors[1].registers[Register.CTRL_MODE] = 2
    bench.motors[1].stubborn = True
    assert "CTRL_MODE) stays at 2" in refusal(bench)


def test_the_gripper_needs_its_own_mode(bench):
    bench.gripper.registers[Register.CTRL_MODE] = 1
    bench.ready()
    assert bench.gripper.registers[Register.CTRL_MODE] == 4


@pytest.mark.parametrize("turn", [-1, 1])
@pytest.mark.parametrize("joint", [0, 1, 3, 5])
def test_a_joint_that_woke_up_a_turn_off_is_folded(bench, turn, joint):
    bench.motors[joint].position += turn * 2 * np.pi
    bench.ready()
    home = bench.robot.profile.home
    assert bench.arm.read().position == pytest.approx(home, abs=4e-4)
    assert len(bench.arm.warnings) == 1
    assert "full turn off" in bench.arm.warnings[0]
    bench.arm.enable()
    # The command goes to where the motor thinks it is.
    assert bench.motors[joint].commands[-1].position == pytest.approx(bench.motors[joint].position, abs=4e-4)


def test_verifying_again_finds_the_same_fold(bench):
    bench.motors[0].position += 2 * np.pi
    bench.ready()
    bench.arm.verify()
    assert bench.arm.read().position[0] == pytest.approx(bench.robot.profile.home[0], abs=4e-4)


def test_a_joint_that_can_be_nowhere_in_its_range(bench):
    bench.motors[3].position = -3.0
    text = refusal(bench)
    assert "panda_joint4" in text
    assert "no angle" in text


@pytest.mark.parametrize(
    ("position", "bounds", "turns"),
    [(0.0, (-1, 1), [0]), (6.3, (-1, 1), [1]), (-6.3, (-1, 1), [-1]), (3.0, (-1, 1), []), (0.0, (-7, 7), [0, -1, 1])],
)
def test_plausible_turns(position, bounds, turns):
    assert plausible_turns(position, bounds, 2 * np.pi) == turns


def test_every_problem_of_one_drive_is_told(bench):
    motor = bench.motors[1]
    motor.registers[Register.TIMEOUT] = 0
    motor.registers[Register.TMAX] = 100.0
    motor.status = 0xE
    bench.arm.connect()
    with pytest.raises(DrivesError) as caught:
        bench.arm.verify()
    assert len(caught.value.problems) == 3
