"""One drive on the host side: requests, retries, and which frames count as its own."""

import math

import pytest

from robotctl.hal.can.channel import Channel
from robotctl.hal.can.damiao.codec import Feedback, RegisterCommand, encode_feedback, encode_register
from robotctl.hal.can.damiao.drive import Drive
from robotctl.hal.can.damiao.faults import fault_of, is_fault, status_name
from robotctl.hal.can.damiao.motors import MOTORS
from robotctl.hal.can.damiao.registers import Register
from robotctl.hal.can.transport import Transport
from robotctl.hal.clock import VirtualClock
from robotctl.hal.errors import DriveError

RANGES = MOTORS["DM4310"]


class Desk:
    def __init__(self, motor, bus_type, scale=1.0, zero=0.0):
        self.motor = motor
        self.bus = bus_type([motor])
        self.clock = VirtualClock(5_000)
        self.transport = Transport(Channel(self.bus, fd=True, simulated=True), self.clock)
        self.drive = Drive("elbow", motor.id, motor.reply_id, RANGES, self.transport, self.clock, scale, zero)

    def receive(self, data, arbitration_id=None):
        self.bus.inject(self.motor.reply_id if arbitration_id is None else arbitration_id, data)
        self.transport.drain()


@pytest.fixture
def desk(scripted_motor, scripted_bus):
    made = Desk(scripted_motor(4, 0x14, RANGES), scripted_bus)
    yield made
    made.transport.close()


def feedback(motor=4, status=1, position=0.5):
    return encode_feedback(Feedback(motor, status, position, 1.0, 2.0, 40, 50), RANGES)


def test_feedback_is_taken(desk):
    desk.receive(feedback())
    drive = desk.drive
    assert (drive.position, drive.velocity, drive.effort) == pytest.approx((0.5, 1.0, 2.0), abs=0.01)
    assert (drive.status, drive.mosfet_temperature, drive.rotor_temperature) == (1, 40, 50)
    assert drive.stamp_ns == 5_000


def test_feedback_is_mapped_to_the_joint(scripted_motor, scripted_bus):
    desk = Desk(scripted_motor(4, 0x14, RANGES), scripted_bus, scale=-2.0, zero=0.3)
    desk.receive(feedback())
    drive = desk.drive
    assert drive.position == pytest.approx(0.5 / -2.0 + 0.3, abs=1e-3)
    assert drive.velocity == pytest.approx(-0.5, abs=0.01)
    assert drive.effort == pytest.approx(-4.0, abs=0.01)
    back = drive.decode(drive.encode(drive.position, drive.velocity, drive.effort, 0))
    assert back == pytest.approx((drive.position, drive.velocity, drive.effort), abs=0.01)
    assert not drive.saturated
    desk.transport.close()


@pytest.mark.parametrize(
    ("data", "arbitration_id"),
    [
        (feedback(motor=5), 0x14),
        (feedback(), 0x15),
        (feedback(), 0x114),
        (feedback()[:7], 0x14),
        (feedback() + b"\0", 0x14),
        (b"", 0x14),
        (encode_register(4, RegisterCommand.WRITE, Register.TIMEOUT, b"\xd0\7\0\0"), 0x14),
        (encode_register(4, RegisterCommand.REFRESH), 0x14),
        (encode_register(4, RegisterCommand.READ, Register.P_M), 0x14),
        (encode_register(4, RegisterCommand.SAVE, 1), 0x14),
    ],
)
def test_what_is_not_its_feedback_is_counted_and_dropped(desk, data, arbitration_id):
    desk.receive(data, arbitration_id)
    assert desk.drive.stamp_ns == 0
    assert math.isnan(desk.drive.position)
    assert desk.transport.unexpected == 1


def test_registers_are_read(desk):
    assert desk.drive.read_register(Register.TIMEOUT) == 2000
    assert desk.drive.read_register(Register.PMAX) == 12.5


def test_a_register_is_asked_for_five_times(desk):
    desk.motor.drop_next = 4
    assert desk.drive.read_register(Register.TIMEOUT) == 2000
    assert len(desk.bus.sent) == 5
    desk.motor.drop_next = 5
    with pytest.raises(DriveError, match=r"elbow \(motor id 0x04\): does not answer"):
        desk.drive.read_register(Register.TIMEOUT)


def test_the_reply_to_another_register_is_no_answer(desk):
    desk.motor.mute = True
    for _ in range(10):
        desk.bus.inject(0x14, encode_register(4, RegisterCommand.READ, Register.PMAX, b"\1\1\1\1"))
    with pytest.raises(DriveError):
        desk.drive.read_register(Register.TIMEOUT)


def test_writes_are_read_back(desk):
    desk.drive.write_register(Register.TIMEOUT, 1000)
    assert desk.motor.registers[Register.TIMEOUT] == 1000
    desk.motor.status = 1
    with pytest.raises(DriveError, match="TIMEOUT\\) stays at 1000, 500 was written"):
        desk.drive.write_register(Register.TIMEOUT, 500)


def test_refresh_waits_for_news(desk):
    desk.motor.position = 1.0
    desk.motor.drop_next = 2
    desk.drive.refresh()
    assert desk.drive.position == pytest.approx(1.0, abs=1e-3)
    desk.motor.mute = True
    with pytest.raises(DriveError):
        desk.drive.refresh()


def test_round_trips_count_only_what_was_asked_for(desk):
    desk.receive(feedback())
    assert len(desk.transport.trips) == 0
    desk.drive.expect_reply(3_000)
    desk.receive(feedback())
    desk.receive(feedback())
    assert list(desk.transport.trips) == [2_000]


def test_replies_to_one_request(desk):
    assert desk.drive.replies_to_one_request() == 1
    desk.motor.copies = 3
    assert desk.drive.replies_to_one_request() == 3
    desk.motor.mute = True
    assert desk.drive.replies_to_one_request() == 0


@pytest.mark.parametrize(
    ("status", "name", "fault"),
    [(0, "DISABLED", False), (1, "ENABLED", False), (13, "COMMUNICATION_LOST", True), (3, "UNKNOWN_3", True)],
)
def test_status_names(status, name, fault):
    assert status_name(status) == name
    assert is_fault(status) == fault
    assert fault_of("elbow", status).name == name
