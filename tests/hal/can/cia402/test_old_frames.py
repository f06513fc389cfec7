"""CiA 402 drives: no frame that has waited is ever acted upon, and none is spoken to before that is shown."""

import pytest

from robotctl.hal.can.cia402.codec import Mode, Service
from robotctl.hal.can.cia402.machine import State, Word
from robotctl.hal.errors import BusError, HardwareError

from .conftest import Desk

MS = 1_000_000
READS_ERROR_REGISTER = bytes((0x40, 0x01, 0x10, 0, 0, 0, 0, 0))


def power(desk: Desk, *, on: bool) -> None:
    for drive in desk.bench.drives:
        drive.power_up() if on else drive.power_down()


def seen(desk: Desk, witness) -> list[tuple[int, bytes]]:
    desk.bus.recv(0.0)
    return [(frame.arbitration_id, bytes(frame.data)) for frame in iter(lambda: witness.recv(0.0), None)]


def until_given_up(desk: Desk) -> None:
    with pytest.raises(BusError, match="take the interface down and up"):
        desk.tick(desk.seconds(0.5), desk.hold())


def test_the_first_that_leaves_is_a_request_that_moves_nothing(desk: Desk):
    witness = desk.bus.witness()
    desk.arm.verify()
    assert seen(desk, witness)[0] == (Service.SDO + 7, READS_ERROR_REGISTER)


def test_its_answer_is_not_taken_for_that_to_the_next_request(mixed):
    desk = Desk(mixed)
    desk.arm._drives.reverse()  # so that the drive that was asked first is read first
    desk.arm._expected.reverse()
    desk.arm.verify()


def test_without_power_nothing_is_verified_and_nothing_stays(desk: Desk):
    power(desk, on=False)
    with pytest.raises(BusError, match="check motor power"):
        desk.arm.verify()
    witness = desk.bus.witness()
    power(desk, on=True)
    assert seen(desk, witness) == []
    desk.arm.verify()


def test_what_waited_for_the_power_is_taken_back(desk: Desk):
    desk.enable()
    power(desk, on=False)
    until_given_up(desk)
    assert desk.bus.waiting()
    with pytest.raises(HardwareError):
        desk.arm.disable()
    witness = desk.bus.witness()
    power(desk, on=True)
    assert seen(desk, witness) == []
    assert all(drive.state is State.OFF for drive in desk.bench.drives)


def test_what_waited_for_room_on_the_bus_is_taken_back(desk: Desk):
    desk.enable()
    desk.bus.occupied = True
    until_given_up(desk)
    desk.arm.close()
    witness = desk.bus.witness()
    desk.bus.occupied = False
    for _ in range(100):
        desk.clock.sleep_until(desk.clock.now_ns() + MS)
        assert seen(desk, witness) == []
    assert not any(drive.enabled for drive in desk.bench.drives)


def test_a_purge_that_did_nothing_is_noticed_before_any_drive_is_spoken_to(desk: Desk):
    desk.enable()
    power(desk, on=False)
    desk.arm.write(desk.hold())
    desk.bus.purges = False
    witness = desk.bus.witness()
    prove = desk.arm._transport._send

    def send_as_the_power_returns(*frame: object) -> None:
        power(desk, on=True)
        prove(*frame)

    desk.arm._transport._send = send_as_the_power_returns
    with pytest.raises(BusError, match="frames that were not sent now have reached the drives, on 0x080, 0x201"):
        desk.arm.verify()
    assert seen(desk, witness)[-1] == (Service.SDO + 7, READS_ERROR_REGISTER)
    desk.bus.recv(0.0)
    assert not any(drive.enabled for drive in desk.bench.drives)


@pytest.mark.parametrize(
    ("arbitration_id", "data"),
    [
        (0x000, bytes((1, 3))),
        (Service.SDO + 3, bytes((0x2B, 0x40, 0x60, 0, Word.SWITCH_ON, 0, 0, 0))),
        (Service.RPDO1 + 3, bytes((Word.ENABLE_OPERATION, 0, Mode.POSITION, 0, 0, 0, 0))),
        (0x008, b"\xff" * 7 + b"\xfc"),
        (0x308, bytes(8)),
    ],
)
def test_whatever_drives_act_upon_counts_as_a_command(mixed, arbitration_id: int, data: bytes):
    desk = Desk(mixed)
    prove = desk.arm._transport._send

    def send_after_another(*frame: object) -> None:
        desk.bus._show(arbitration_id, data)
        prove(*frame)

    desk.arm._transport._send = send_after_another
    with pytest.raises(BusError, match=f"on 0x{arbitration_id:03X}"):
        desk.arm.verify()


def test_an_arm_without_power_is_asked_once_and_again_when_it_is_back(desk: Desk):
    desk.arm.verify()
    power(desk, on=False)
    desk.tick(desk.seconds(1.0))
    assert desk.arm.bus_statistics()["send_failures"] == 0
    assert len(desk.bus._waiting) <= 2  # a heartbeat and a SYNC
    power(desk, on=True)
    assert desk.tick(desk.seconds(0.3)).faults[0].name == "NOT_OPERATIONAL"
    desk.arm.verify()
    assert desk.tick(2).faults == ()
