"""One emulated CiA 402 drive on a bench, frame by frame: dictionary, network management, PDOs, states, heartbeats."""

import struct
from collections.abc import Iterator

import numpy as np
import pytest

from robotctl.hal.can.cia402 import objects as od
from robotctl.hal.can.cia402.codec import (
    Mode,
    NmtCommand,
    decode_emergency,
    decode_motion,
    decode_status,
    encode_feed_forward,
    encode_nmt,
    encode_setpoint,
)
from robotctl.hal.can.cia402.machine import State, state_of
from robotctl.hal.errors import ConfigError
from robotctl.hal.robot import load_robot
from robotctl.sim.motors.bench import Bench
from robotctl.sim.motors.orders import order_register, order_trouble
from robotctl.sim.motors.trouble import Deaf, Delay, Frozen, Misreport, PowerCut, Runaway, Stuck

NODE = 1
COUNTS = 131072 * 100 / (2 * np.pi)
MS = 1_000_000


class Desk:
    def __init__(self) -> None:
        self.bench = Bench(load_robot("xarm7"))
        self.drive = self.bench.drive("joint1")

    def send(self, arbitration_id: int, data: bytes) -> list[tuple[int, bytes]]:
        """Send a frame, and return what is said because of it."""
        self.bench.advance(self.bench.now_ns)
        self.bench.receive(arbitration_id, data)
        return self.heard()

    def heard(self) -> list[tuple[int, bytes]]:
        found = [(reply.arbitration_id, reply.data) for reply in self.bench.replies]
        self.bench.replies.clear()
        return found

    def wait(self, milliseconds: float, beats: bool = True) -> list[tuple[int, bytes]]:
        """Let time pass, with the host's heartbeat every 20 ms."""
        end = self.bench.now_ns + round(milliseconds * MS)
        while self.bench.now_ns < end:
            if beats:
                self.bench.receive(0x77F, b"\x05")
            self.bench.advance(min(self.bench.now_ns + 20 * MS, end))
        return self.heard()

    def upload(self, index: int, sub: int = 0) -> bytes:
        ((arbitration_id, answer),) = self.send(0x600 + NODE, struct.pack("<BHBI", 0x40, index, sub, 0))
        assert arbitration_id == 0x580 + NODE
        return answer

    def download(self, index: int, sub: int, value: int, size: int) -> bytes:
        command = 0x23 | (4 - size) << 2
        ((_, answer),) = self.send(0x600 + NODE, struct.pack("<BHBI", command, index, sub, value))
        return answer

    def map(self) -> None:
        for number, entries in enumerate((*od.RPDOS, *od.TPDOS)):
            base, mapping = (0x1400, 0x1600) if number < 2 else (0x1800, 0x1A00)
            which = number % 2
            identifier = (0x200, 0x300, 0x180, 0x280)[number] + NODE
            self.download(base + which, 1, od.INVALID, 4)
            self.download(base + which, 2, 1, 1)
            self.download(mapping + which, 0, 0, 1)
            for sub, entry in enumerate(entries, 1):
                assert self.download(mapping + which, sub, od.mapped(entry), 4)[0] == 0x60
            self.download(mapping + which, 0, len(entries), 1)
            assert self.download(base + which, 1, identifier, 4)[0] == 0x60
        self.download(0x60C2, 1, 5, 1)
        self.send(0, encode_nmt(NmtCommand.START, NODE))

    def cycle(self, word: int, mode: int = Mode.POSITION, position: int = 0, velocity: int = 0, torque: int = 0):
        """Send a whole cycle; return status and motion, 5 ms later."""
        self.send(0x201, encode_setpoint((word, mode, position)))
        self.send(0x301, encode_feed_forward((velocity, torque)))
        found = dict(self.send(0x080, b""))
        self.wait(5)
        return decode_status(found[0x181]), decode_motion(found[0x281])

    def enable(self) -> None:
        self.map()
        for word in (0x06, 0x07, 0x0F, 0x0F):
            status, _ = self.cycle(word, position=self.drive.dictionary.get((0x6064, 0)))
        assert state_of(status.statusword) is State.ENABLED


@pytest.fixture
def desk() -> Iterator[Desk]:
    return Desk()


# -- transfers ---------------------------------------------------------------------------------------------------------


def test_values_are_read_in_their_own_length(desk: Desk):
    assert desk.upload(0x1000) == bytes.fromhex("43 00 10 00 92 01 02 00")
    assert desk.upload(0x6041) == bytes.fromhex("4b 41 60 00 50 02 00 00")
    assert desk.upload(0x6061) == bytes.fromhex("4f 61 60 00 00 00 00 00")


@pytest.mark.parametrize(
    ("request_", "code"),
    [
        (bytes.fromhex("40 99 99 00 00 00 00 00"), 0x06020000),  # no such object
        (bytes.fromhex("40 18 10 09 00 00 00 00"), 0x06090011),  # no such sub-index
        (bytes.fromhex("2b 41 60 00 00 00 00 00"), 0x06010002),  # read only
        (bytes.fromhex("23 40 60 00 00 00 00 00"), 0x06070010),  # four bytes for two
        (bytes.fromhex("21 40 60 00 08 00 00 00"), 0x06070010),  # not expedited
        (bytes.fromhex("a0 40 60 00 00 00 00 00"), 0x05040001),  # block transfer
        (bytes.fromhex("2f 60 60 00 06 00 00 00"), 0x06090030),  # homing, which it has not
        (bytes.fromhex("23 10 10 01 00 00 00 00"), 0x08000020),  # stored without the word
    ],
)
def test_what_it_refuses_it_refuses_by_the_standard_s_code(desk: Desk, request_: bytes, code: int):
    ((_, answer),) = desk.send(0x601, request_)
    assert (answer[0], answer[1:4]) == (0x80, request_[1:4])
    assert int.from_bytes(answer[4:], "little") == code


@pytest.mark.parametrize("request_", [bytes(7), bytes.fromhex("80 40 60 00 00 00 00 00")])
def test_what_is_no_request_is_not_answered(desk: Desk, request_: bytes):
    assert desk.send(0x601, request_) == []


def test_what_is_stored_outlives_its_power(desk: Desk):
    desk.download(0x1017, 0, 50, 2)
    desk.drive.power_down()
    desk.drive.power_up()
    assert desk.heard() == [(0x701, b"\0")]
    assert desk.drive.dictionary[od.HEARTBEAT_PRODUCER] == 100
    desk.download(0x1017, 0, 50, 2)
    desk.download(0x1010, 1, int.from_bytes(b"save", "little"), 4)
    desk.drive.power_up()
    assert desk.drive.dictionary[od.HEARTBEAT_PRODUCER] == 50
    assert desk.drive.cycles == 1


# -- PDOs --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("index", "sub", "value", "size", "code"),
    [
        (0x1600, 1, 0x60400010, 4, 0x08000022),  # while the PDO is valid
        (0x1A01, 1, 0x99990010, 4, 0x06040041),  # nothing there to map
        (0x1A01, 1, 0x60410020, 4, 0x06040041),  # of another length
        (0x1A01, 0, 9, 1, 0x06040042),  # more than there is room for
    ],
)
def test_mappings_that_cannot_be_are_refused(desk: Desk, index: int, sub: int, value: int, size: int, code: int):
    answer = desk.download(index, sub, value, size)
    assert answer[0] == 0x80
    assert int.from_bytes(answer[4:], "little") == code


def test_more_than_eight_bytes_do_not_fit_a_frame(desk: Desk):
    for sub in (1, 2, 3):
        desk.download(0x1A01, sub, 0x60640020, 4)
    assert int.from_bytes(desk.download(0x1A01, 0, 3, 1)[4:], "little") == 0x06040042
    assert desk.download(0x1A01, 0, 2, 1)[0] == 0x60


def test_once_it_is_operational_its_mapping_stays(desk: Desk):
    desk.map()
    assert int.from_bytes(desk.download(0x1800, 1, od.INVALID, 4)[4:], "little") == 0x08000022


def test_setpoints_wait_for_sync(desk: Desk):
    desk.map()
    desk.send(0x201, encode_setpoint((0x06, 8, 0)))
    assert desk.drive.state is State.OFF
    desk.send(0x080, b"")
    assert desk.drive.state is State.READY


def test_a_pdo_that_is_too_short_is_an_emergency(desk: Desk):
    desk.map()
    ((arbitration_id, data),) = desk.send(0x201, b"\x06\x00")
    assert arbitration_id == 0x081
    assert decode_emergency(data).code == 0x8210


def test_before_it_is_operational_it_hears_no_pdo_and_no_sync(desk: Desk):
    assert desk.send(0x080, b"") == []
    desk.send(0x201, encode_setpoint((0x06, 8, 0)))
    assert desk.drive.state is State.OFF


# -- network management ------------------------------------------------------------------------------------------------


def test_commands_are_for_one_node_or_for_all(desk: Desk):
    desk.send(0, encode_nmt(NmtCommand.START, 2))
    assert [drive.nmt for drive in desk.bench.drives[:3]] == [0x7F, 5, 0x7F]
    desk.send(0, encode_nmt(NmtCommand.START, 0))
    assert {drive.nmt for drive in desk.bench.drives} == {5}


def test_a_reset_boots_without_torque_and_with_what_was_stored(desk: Desk):
    desk.enable()
    assert desk.send(0, encode_nmt(NmtCommand.RESET_NODE, NODE)) == [(0x701, b"\0")]
    assert desk.drive.state is State.OFF
    assert desk.drive.dictionary.values[0x1A00, 0] == 1


def test_a_stopped_node_answers_nothing_and_its_motor_stands(desk: Desk):
    desk.enable()
    desk.send(0, encode_nmt(NmtCommand.STOP, NODE))
    assert desk.send(0x601, struct.pack("<BHBI", 0x40, 0x1000, 0, 0)) == []
    desk.wait(100)
    assert desk.drive.state is State.OFF


def test_heartbeats_tell_its_network_state(desk: Desk):
    assert {data for found, data in desk.wait(250) if found == 0x701} == {b"\x7f"}
    desk.map()
    beats = [data for found, data in desk.wait(1000) if found == 0x701]
    assert beats == [b"\x05"] * 10


# -- states and motion -------------------------------------------------------------------------------------------------


def test_words_in_another_order_lead_nowhere(desk: Desk):
    desk.map()
    for word in (0x0F, 0x07):
        desk.cycle(word)
        assert desk.drive.state is State.OFF


def test_a_position_is_reached_one_cycle_later(desk: Desk):
    desk.enable()
    speed = 0.2
    for step in range(1, 200):
        status, motion = desk.cycle(0x0F, position=round(speed * 0.005 * step * COUNTS), velocity=round(speed * COUNTS))
    assert desk.drive._loops.reference / 100 == pytest.approx(speed * 0.005 * 199, abs=1e-6)
    assert status.position / COUNTS == pytest.approx(speed * 0.005 * 198, abs=6e-3)  # dry friction
    assert motion.velocity / COUNTS == pytest.approx(speed, abs=0.02)
    assert motion.mode == Mode.POSITION


def test_without_new_targets_it_goes_on_for_a_cycle_and_stands(desk: Desk):
    desk.enable()
    for step in range(1, 100):
        desk.cycle(0x0F, position=round(0.001 * step * COUNTS), velocity=round(0.2 * COUNTS))
    before = desk.drive._loops.reference / 100
    desk.wait(60)
    assert desk.drive._loops.reference / 100 - before == pytest.approx(0.001, abs=3e-4)


def test_a_velocity_of_zero_stands_and_a_torque_pushes(desk: Desk):
    desk.enable()
    for _ in range(100):
        desk.cycle(0x0F, Mode.VELOCITY)
    assert abs(desk.drive.angle) < 0.1
    for _ in range(40):
        status, _ = desk.cycle(0x0F, Mode.TORQUE, torque=200)
    assert status.torque == 200
    assert desk.drive.angle > 0.1


def test_a_quick_stop_brakes_and_ends_without_torque(desk: Desk):
    desk.enable()
    for step in range(1, 100):
        desk.cycle(0x0F, position=round(0.004 * step * COUNTS), velocity=round(0.8 * COUNTS))
    desk.cycle(0x02)
    assert desk.drive.state is State.QUICK_STOP
    desk.wait(100)
    assert desk.drive.state is State.OFF
    assert abs(desk.drive.shaft.state()[1]) < 1.0


def test_a_target_far_away_is_a_following_error(desk: Desk):
    desk.enable()
    desk.send(0x201, encode_setpoint((0x0F, Mode.POSITION, round(3.0 * COUNTS))))
    desk.send(0x080, b"")
    codes = [decode_emergency(data).code for found, data in desk.wait(50) if found == 0x081]
    assert codes == [0x8611]
    assert desk.drive.state is State.FAULT


def test_a_fault_goes_at_the_edge_of_the_reset_bit_and_enables_nothing(desk: Desk):
    desk.enable()
    desk.drive.fail()
    desk.cycle(0x8F)
    assert desk.drive.state is State.OFF
    desk.drive.fail()
    for _ in range(3):
        desk.cycle(0x80)
        assert desk.drive.state is State.FAULT  # the bit has been up since before
    desk.cycle(0x00)
    desk.cycle(0x80)
    assert desk.drive.state is State.OFF


# -- the host's heartbeat ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("option", "state"), [(0, State.ENABLED), (1, State.FAULT), (2, State.OFF), (3, State.OFF)])
def test_without_its_host_it_does_what_it_was_told_to(desk: Desk, option: int, state: State):
    desk.drive.preset(od.ABORT_OPTION, option)
    desk.enable()
    desk.wait(200)
    assert desk.drive.enabled
    heard = desk.wait(200, beats=False)
    assert desk.drive.state is state
    codes = [decode_emergency(data).code for found, data in heard if found == 0x081]
    assert codes == [0x8130]
    ((_, data),) = [frame for frame in desk.send(0x77F, b"\x05") if frame[0] == 0x081]
    assert decode_emergency(data).code == (0x8130 if state is State.FAULT else 0)


def test_it_waits_for_a_host_only_once_it_has_heard_one(desk: Desk):
    assert all(found == 0x701 for found, _ in desk.wait(500, beats=False) if found & 0x7F == NODE)


# -- trouble -----------------------------------------------------------------------------------------------------------


def test_trouble_of_every_kind_acts_on_it(desk: Desk):
    desk.enable()
    plant = {
        Misreport(motor_id=NODE, offset=1.0, tell=desk.drive.shifted): lambda s, m: s.position > 20_000,
        Frozen(motor_id=NODE, angle=2.0, tell=desk.drive.frozen): lambda s, m: s.position == 41722 and m.velocity == 0,
    }
    for trouble, shows in plant.items():
        desk.bench.trouble.add(trouble)
        assert shows(*desk.cycle(0x0F))
        desk.bench.trouble.remove(trouble)
    for trouble in (Deaf(motor_id=NODE), Stuck(motor_id=NODE), Runaway(motor_id=NODE, torque=0.05)):
        desk.bench.trouble.add(trouble)
        desk.wait(5)
        desk.bench.trouble.remove(trouble)
    desk.bench.trouble.add(PowerCut(motor_id=NODE))
    assert not [found for found, _ in desk.wait(300) if found & 0x7F == NODE]


def test_late_answers_are_late(desk: Desk):
    desk.map()
    desk.bench.trouble.add(Delay(motor_id=NODE, delay_s=0.003))
    assert desk.send(0x080, b"") == []
    assert [found for found, _ in desk.wait(4)] == [0x181, 0x281]


def test_orders_name_objects_and_error_codes(desk: Desk):
    order_register(desk.bench, "all:0x1016.1=0x7f0064")
    assert {drive.dictionary[od.HEARTBEAT_CONSUMER] for drive in desk.bench.drives} == {127 << 16 | 100}
    order_register(desk.bench, "joint2:0x6007=1")
    assert desk.bench.drive(2).dictionary[od.ABORT_OPTION] == 1
    order_trouble(desk.bench, "fault:joint3:0x7121")
    assert desk.bench.drive(3).told(desk.bench.drive(3).status) == "FAULT (MOTOR_BLOCKED)"


@pytest.mark.parametrize("order", ["joint1:0x9999=1", "joint1:speed=1", "joint1:0x6007=x"])
def test_orders_that_no_drive_understands_are_refused(desk: Desk, order: str):
    with pytest.raises(ConfigError, match="register"):
        order_register(desk.bench, order)


def test_the_same_frames_at_the_same_times_are_answered_alike():
    runs = []
    for _ in range(2):
        desk = Desk()
        desk.enable()
        runs.append([desk.cycle(0x0F, position=100 * step, velocity=20_000) for step in range(50)])
    assert runs[0] == runs[1]
