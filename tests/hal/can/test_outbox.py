"""Nothing old is sent: what waits is held back, taken back, and shown to be gone."""

import can
import pytest

from robotctl.hal.backend import open_backend
from robotctl.hal.can.channel import Channel
from robotctl.hal.can.damiao.codec import Special, encode_special
from robotctl.hal.can.transport import FAILING_LIMIT_NS, WAITING_LIMIT_NS, Transport
from robotctl.hal.clock import VirtualClock
from robotctl.hal.errors import BusError, HardwareError
from robotctl.hal.robot import Robot
from robotctl.sim.motors.bench import Bench
from robotctl.sim.motors.bus import QUEUE, EmulatedBus

MS = 1_000_000
PROBE = (0x7FF, bytes([1, 0, 0xCC, 0, 0, 0, 0, 0]))
COMMANDS = range(1, 9)
CYCLE = [(identifier, bytes(8)) for identifier in COMMANDS]


class Line:
    """A transport to emulated drives, whose power can be cut."""

    def __init__(self, robot: Robot) -> None:
        self.clock = VirtualClock(MS)
        self.bench = Bench(robot, MS)
        self.bus = EmulatedBus(self.bench, self.clock)
        self.transport = Transport(Channel(self.bus, fd=True, simulated=True, outbox=self.bus), self.clock)
        self.witness = self.bus.witness()

    def power(self, on: bool) -> None:
        for drive in self.bench.drives:
            drive.power_up() if on else drive.power_down()

    def pass_time(self, nanoseconds: int) -> None:
        self.clock.sleep_until(self.clock.now_ns() + nanoseconds)

    def left(self) -> list[int]:
        self.bus.recv(0.0)
        return [frame.arbitration_id for frame in iter(lambda: self.witness.recv(0.0), None)]

    def prove(self) -> None:
        self.transport.prove_empty(PROBE, COMMANDS)


@pytest.fixture
def line(panda: Robot) -> Line:
    return Line(panda)


def test_on_a_sound_bus_nothing_waits(line: Line) -> None:
    line.transport.send_all(CYCLE)
    assert not line.transport.waiting
    line.prove()
    assert line.left() == [*COMMANDS, 0x7FF]


def test_without_a_purge_old_frames_are_sent_when_the_power_returns(line: Line) -> None:
    line.power(on=False)
    line.transport.send_all(CYCLE)
    assert line.transport.waiting
    assert line.left() == []
    line.power(on=True)
    assert line.left() == list(COMMANDS)


def test_no_more_than_two_cycles_ever_wait(line: Line) -> None:
    line.power(on=False)
    left = []
    for _ in range(10):
        left.append(line.transport.send_all(CYCLE))
        line.pass_time(2 * MS)
    assert left == [8, 8] + [0] * 8
    assert line.transport.send_failures == 8
    assert 4 * MS == WAITING_LIMIT_NS


def test_frames_that_take_torque_away_may_wait(line: Line) -> None:
    line.power(on=False)
    line.transport.send(1, bytes(8))
    line.pass_time(WAITING_LIMIT_NS)
    off = encode_special(Special.DISABLE)
    assert not line.transport.send(1, off)
    assert line.transport.send(1, off, force=True)


def test_a_bus_that_nothing_leaves_is_given_up(line: Line) -> None:
    line.power(on=False)
    line.transport.send_all(CYCLE)
    line.pass_time(WAITING_LIMIT_NS)
    line.transport.send_all(CYCLE)
    line.pass_time(FAILING_LIMIT_NS + 1)
    with pytest.raises(BusError, match="frames wait, and do not leave") as caught:
        line.transport.send_all(CYCLE)
    assert "take the interface down and up" in str(caught.value)


def test_a_babbling_node_that_leaves_no_room_is_noticed_alike(line: Line) -> None:
    line.bus.occupied = True
    line.transport.send_all(CYCLE)
    line.pass_time(WAITING_LIMIT_NS)
    assert line.transport.send_all(CYCLE) == 0
    line.bus.occupied = False
    assert line.transport.send_all(CYCLE) == 8


def test_what_is_taken_back_is_never_sent(line: Line) -> None:
    line.power(on=False)
    line.transport.send_all(CYCLE)
    line.transport.drain()
    assert line.transport.state == "passive"
    line.transport.purge()
    assert not line.transport.waiting
    assert line.transport.state == "active"
    line.power(on=True)
    assert line.left() == []
    assert line.transport.send_all(CYCLE) == 8


def test_nothing_is_proved_while_nobody_acknowledges_and_the_probe_does_not_stay(line: Line) -> None:
    line.power(on=False)
    with pytest.raises(BusError, match="nobody acknowledges"):
        line.prove()
    line.power(on=True)
    assert line.left() == []
    line.prove()


def test_a_purge_that_did_nothing_is_noticed(line: Line) -> None:
    line.power(on=False)
    line.transport.send_all(CYCLE)
    line.bus.purges = False
    sent = line.transport.send

    def probe_as_the_power_returns(arbitration_id: int, data: bytes) -> bool:
        line.power(on=True)
        return sent(arbitration_id, data)

    line.transport.send = probe_as_the_power_returns
    with pytest.raises(BusError, match="8 frames that were not sent now have reached the drives, on 0x001, 0x002"):
        line.prove()


def test_the_queue_is_as_long_as_the_interfaces(line: Line) -> None:
    line.power(on=False)
    message = can.Message(arbitration_id=1, is_extended_id=False, data=bytes(8))
    for _ in range(QUEUE):
        line.bus.send(message)
    with pytest.raises(can.CanOperationError, match="buffer space"):
        line.bus.send(message)


def test_a_channel_that_tells_nothing_is_not_asked(line: Line) -> None:
    transport = Transport(Channel(line.bus, fd=True, simulated=True), line.clock)
    line.power(on=False)
    transport.send_all(CYCLE)
    assert not transport.waiting
    transport.purge()
    transport.prove_empty(PROBE, COMMANDS)


# -- the arm -----------------------------------------------------------------------------------------------------------


def enabled_arm(robot: Robot):
    arm = open_backend("can", robot, VirtualClock()).arm
    arm.connect()
    arm.verify()
    arm.enable()
    return arm, arm.channel.bus


def cut(bus: EmulatedBus, on: bool = False) -> None:
    for drive in bus.bench.drives:
        drive.power_up() if on else drive.power_down()


def test_an_arm_that_cannot_be_disabled_leaves_nothing_behind(panda: Robot) -> None:
    arm, bus = enabled_arm(panda)
    cut(bus)
    arm.hold()
    assert bus.waiting()
    with pytest.raises(HardwareError):
        arm.disable()
    assert not bus.waiting()


def test_an_arm_that_is_closed_leaves_nothing_behind(panda: Robot) -> None:
    arm, bus = enabled_arm(panda)
    cut(bus)
    arm.hold()
    arm.close()
    assert not bus.waiting()


def test_an_arm_without_power_is_asked_once_and_again_when_it_is_back(panda: Robot) -> None:
    clock = VirtualClock()
    arm = open_backend("can", panda, clock).arm
    arm.connect()
    arm.verify()
    bus = arm.channel.bus
    cut(bus)
    for _ in range(500):
        clock.sleep_until(clock.now_ns() + 2 * MS)
        arm.read()
    assert arm.bus_statistics()["send_failures"] == 0
    cut(bus, on=True)
    for _ in range(5):
        clock.sleep_until(clock.now_ns() + 2 * MS)
        sample = arm.read()
    assert clock.now_ns() - sample.joint_stamp_ns.min() < 10 * MS
    assert not sample.faults


def test_an_arm_is_not_verified_before_its_bus_is_shown_to_be_empty(panda: Robot) -> None:
    arm, bus = enabled_arm(panda)
    cut(bus)
    with pytest.raises(BusError, match="check motor power"):
        arm.verify()
    cut(bus, on=True)
    witness = bus.witness()
    arm.verify()
    first = witness.recv(0.0)
    assert (first.arbitration_id, first.data[2]) == (0x7FF, 0xCC)
