"""What is set once on a drive is written, read back, stored and counted, and refused where it would do harm."""

import can
import pytest

from robotctl.hal.can.channel import Channel
from robotctl.hal.can.damiao.codec import RegisterCommand, Special, encode_special
from robotctl.hal.can.damiao.desk import DamiaoMotor
from robotctl.hal.can.damiao.registers import Register
from robotctl.hal.can.service import make_motor
from robotctl.hal.can.transport import Transport
from robotctl.hal.clock import VirtualClock
from robotctl.hal.errors import ConfigError, DriveError
from robotctl.hal.robot import load_robot
from robotctl.sim.motors.bench import Bench
from robotctl.sim.motors.bus import EmulatedBus
from robotctl.sim.motors.trouble import Drop, Duplicate, Mute

ROBOT = load_robot("openarm")


class Desk:
    """The drives of an arm, and one of them at the desk."""

    def __init__(self, motor_id: int = 3) -> None:
        self.clock = VirtualClock()
        self.bench = Bench(ROBOT)
        self.bus = EmulatedBus(self.bench, self.clock)
        self.transport = Transport(Channel(self.bus, fd=True, simulated=True), self.clock)
        self.motor = self.at(motor_id)
        self.drive = self.bench.drive(motor_id)

    def at(self, motor_id: int) -> DamiaoMotor:
        return make_motor("damiao", self.transport, self.clock, motor_id, f"joint{motor_id}")

    def send(self, special: Special) -> None:
        message = can.Message(arbitration_id=self.drive.id, data=encode_special(special), is_extended_id=False)
        self.bus.send(message, 0.001)

    def flash(self, register: Register) -> float:
        """What it starts with the next time that it gets power."""
        self.drive.power_down()
        self.drive.power_up()
        return self.drive.memory[register]


@pytest.fixture
def desk():
    made = Desk()
    yield made
    made.bus.shutdown()


def test_everything_that_it_stores_can_be_read(desk):
    found = desk.motor.read()
    assert (found["PMAX"], found["VMAX"], found["TMAX"]) == (12.5, 10.0, 28.0)
    assert found["TIMEOUT"] == 1600
    assert desk.motor.serial() == 0x26000003
    assert desk.motor.status() == "DISABLED"


def test_a_watchdog_is_in_the_flash_after_one_write_cycle(desk):
    desk.motor.set_watchdog(0.06)
    assert desk.drive.memory.cycles == desk.motor.flash_writes == 1
    assert desk.flash(Register.TIMEOUT) == 1200


def test_storing_that_is_not_confirmed_is_tried_again_and_every_time_counts(desk):
    lost = Mute(motor_id=3)
    send, stored = desk.bus.send, []

    def lose_the_first_confirmation(message, timeout=None):
        if message.data[2] == RegisterCommand.SAVE:
            stored.append(message)
            (desk.bench.trouble.add if len(stored) == 1 else desk.bench.trouble.remove)(lost)
        send(message, timeout)

    desk.transport._send = lose_the_first_confirmation
    desk.motor.write({"TIMEOUT": 1000})
    assert desk.drive.memory.cycles == desk.motor.flash_writes == len(stored) == 2


@pytest.mark.parametrize("seconds", [0.0, -1.0, 1e-6, 11.0, float("nan")])
def test_no_watchdog_is_no_setting(desk, seconds):
    with pytest.raises(ConfigError, match="cannot be set"):
        desk.motor.set_watchdog(seconds)


def test_new_ids_act_at_once_and_are_kept(desk):
    desk.motor.set_id(9, 0x19)
    assert desk.motor.id == 9
    assert desk.motor.read()["MST_ID"] == 0x19
    assert desk.drive.memory.cycles == 1
    assert (desk.flash(Register.ESC_ID), desk.flash(Register.MST_ID)) == (9, 0x19)
    with pytest.raises(DriveError, match="does not answer"):
        desk.at(3).read()


@pytest.mark.parametrize(("new", "reply"), [(0, 0x10), (0x80, 0x90), (9, 0), (9, 0x800), (9, 9)])
def test_ids_that_cannot_be(desk, new, reply):
    with pytest.raises(ConfigError, match="cannot be"):
        desk.motor.set_id(new, reply)


def test_an_id_that_is_taken_is_refused(desk):
    with pytest.raises(DriveError, match="0x04 is taken"):
        desk.motor.set_id(4, 0x14)
    assert desk.drive.id == 3
    assert desk.drive.memory.cycles == 0


def test_a_zero_is_where_the_joint_stands(desk):
    desk = Desk(4)
    assert desk.drive.angle == pytest.approx(0.2, abs=0.01)
    assert desk.motor.set_zero() == pytest.approx(0.0, abs=1e-3)
    assert desk.drive.angle == pytest.approx(0.0, abs=1e-3)
    desk.bus.shutdown()


@pytest.mark.parametrize(
    "order",
    [
        lambda motor: motor.set_watchdog(0.06),
        lambda motor: motor.set_id(9, 0x19),
        lambda motor: motor.set_zero(),
        lambda motor: motor.write({"KP_ASR": 0.1}),
    ],
)
def test_an_enabled_drive_and_twins_are_left_alone(desk, order):
    desk.drive.preset(Register.TIMEOUT, 0)
    desk.send(Special.ENABLE)
    with pytest.raises(DriveError, match="is enabled"):
        order(desk.motor)
    desk.send(Special.DISABLE)
    desk.bench.drive(4).preset(Register.ESC_ID, 3)
    with pytest.raises(DriveError, match="2 drives answer"):
        order(desk.motor)
    assert desk.motor.flash_writes == 0
    desk.bench.trouble.add(Mute())
    with pytest.raises(DriveError, match="does not answer"):
        order(desk.motor)
    assert [drive.memory.cycles for drive in desk.bench.drives] == [0] * 8


def test_what_would_cut_the_connection_or_cannot_be_is_refused_before_anything_is_written(desk):
    for parameters in ({"KP_ASR": 0.1, "can_br": 4}, {"ESC_ID": 4}, {"CTRL_MODE": 9}, {"SN": 1}, {"nonsense": 1}):
        with pytest.raises(ConfigError):
            desk.motor.write(parameters)
    assert desk.drive.memory.cycles == 0
    assert desk.drive.memory[25] == pytest.approx(4e-3)


def test_lost_and_doubled_replies_do_no_harm(desk):
    desk.bench.trouble.add(Drop(probability=0.15))
    desk.bench.trouble.add(Duplicate(motor_id=3, probability=0.1))
    desk.motor.write({"KP_ASR": 0.125, "TIMEOUT": 1000})
    assert desk.flash(Register.TIMEOUT) == 1000


def test_differences_are_those_that_the_drive_can_tell(desk):
    found = desk.motor.read()
    assert desk.motor.differences(found, found) == []
    # 0.004 is not one of the numbers of 32 bits, and means the one that is nearest.
    wanted = {**found, "KP_ASR": 0.004, "VMAX": 8.0, "VBus": 12.0, "p_m": 3.0}
    assert desk.motor.differences(wanted, found) == [("VMAX", 8.0, 10.0)]


def test_departures_from_the_profile(desk):
    wiring = ROBOT.profile.joints[2].drive
    assert desk.motor.departures(ROBOT, wiring, 1, desk.motor.read()) == []
    desk.drive.preset(Register.TIMEOUT, 0)
    desk.drive.preset(Register.CTRL_MODE, 2)
    desk.drive.preset(Register.CAN_BR, 4)
    found = desk.motor.departures(ROBOT, wiring, 1, desk.motor.read())
    assert found == [("TIMEOUT", 2000, 0), ("CTRL_MODE", 1, 2), ("can_br", 9, 4)]
