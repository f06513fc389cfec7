"""Trouble, from the host's side of the bus."""

import can
import pytest

from robotctl.hal.can.damiao.codec import (
    BROADCAST_ID,
    MitCommand,
    RegisterCommand,
    Special,
    Status,
    decode_feedback,
    encode_mit,
    encode_register,
    encode_special,
)
from robotctl.hal.can.damiao.registers import Register
from robotctl.hal.can.error_frames import ERROR_CONTROLLER, GARBLED, UNACKNOWLEDGED
from robotctl.hal.clock import VirtualClock
from robotctl.hal.errors import ConfigError
from robotctl.hal.robot import Robot
from robotctl.sim.motors.bench import Bench
from robotctl.sim.motors.bus import EmulatedBus
from robotctl.sim.motors.orders import order_register, order_trouble
from robotctl.sim.motors.trouble import (
    Corrupt,
    Deaf,
    Delay,
    Drop,
    Duplicate,
    Failure,
    Misreport,
    Mute,
    PowerCut,
    Runaway,
    Short,
    Stuck,
    UnderVoltage,
    Unterminated,
    Weak,
    WrongZero,
)

MS = 1_000_000
MOTOR = 7


class Desk:
    def __init__(self, robot: Robot, seed: int = 0) -> None:
        self.clock = VirtualClock()
        self.bench = Bench(robot, seed=seed)
        self.bus = EmulatedBus(self.bench, self.clock)
        self.drive = self.bench.drive(MOTOR)
        self.errors: list[int] = []

    def ask(self, data: bytes = b"", identifier: int = MOTOR) -> list[can.Message]:
        self.clock.sleep_until(self.clock.now_ns() + MS)
        self.bus.send(can.Message(arbitration_id=identifier, is_extended_id=False, data=data or bytes(8)))
        frames = list(iter(lambda: self.bus.recv(0.0), None))
        self.errors += [frame.arbitration_id for frame in frames if frame.is_error_frame]
        return [frame for frame in frames if not frame.is_error_frame]

    def status(self) -> int:
        request = encode_register(MOTOR, RegisterCommand.REFRESH)
        return decode_feedback(self.ask(request, BROADCAST_ID)[0].data, self.drive.ranges).status


@pytest.fixture
def desk(panda: Robot) -> Desk:
    return Desk(panda)


def test_mute_from_and_until_and_only_that_motor(desk: Desk) -> None:
    desk.bench.trouble.add(Mute(motor_id=MOTOR, from_ns=10 * MS, until_ns=20 * MS))
    heard = []
    for _ in range(30):
        if desk.ask():
            heard.append(desk.clock.now_ns() // MS)
        assert len(desk.ask(identifier=1)) == 1
    assert heard == [1, 3, 5, 7, 9, *range(21, 60, 2)]


def test_a_mute_motor_obeys(desk: Desk) -> None:
    desk.bench.trouble.add(Mute(motor_id=MOTOR))
    assert desk.ask(encode_special(Special.ENABLE)) == []
    assert desk.drive.enabled


def test_a_deaf_motor_does_not(desk: Desk) -> None:
    desk.bench.trouble.add(Deaf(motor_id=MOTOR))
    assert desk.ask(encode_special(Special.ENABLE)) == []
    assert desk.ask(encode_register(MOTOR, RegisterCommand.READ, 9), BROADCAST_ID) == []
    assert not desk.drive.enabled


def test_trouble_can_be_taken_away(desk: Desk) -> None:
    trouble = Mute()
    desk.bench.trouble.add(trouble)
    assert desk.ask() == []
    desk.bench.trouble.remove(trouble)
    desk.bench.trouble.remove(trouble)
    assert len(desk.ask()) == 1


def test_drop_is_seeded(panda: Robot) -> None:
    def run(seed: int) -> list[int]:
        desk = Desk(panda, seed)
        desk.bench.trouble.add(Drop(motor_id=MOTOR, probability=0.3))
        return [len(desk.ask()) for _ in range(200)]

    assert run(1) == run(1)
    assert run(1) != run(2)
    # Lost on the way there or on the way back.
    assert sum(run(1)) / 200 == pytest.approx(0.49, abs=0.1)


def test_delay(desk: Desk) -> None:
    desk.bench.trouble.add(Delay(motor_id=MOTOR, delay_s=0.005))
    assert desk.ask() == []
    sent = desk.clock.now_ns()
    message = desk.bus.recv(0.1)
    assert message.timestamp == pytest.approx((sent + 5 * MS) * 1e-9)
    assert desk.clock.now_ns() == sent + 5 * MS


def test_jitter_brings_replies_out_of_order(desk: Desk) -> None:
    desk.bench.trouble.add(Delay(delay_s=0.0, jitter_s=0.02))
    for identifier in range(1, 8):
        desk.bus.send(can.Message(arbitration_id=identifier, is_extended_id=False, data=bytes(8)))
    order = [desk.bus.recv(0.1).arbitration_id for _ in range(7)]
    assert sorted(order) == list(range(0x11, 0x18))
    assert order != sorted(order)


def test_duplicate(desk: Desk) -> None:
    desk.bench.trouble.add(Duplicate(motor_id=MOTOR))
    first, second = desk.ask()
    assert first.data == second.data


def test_corrupt_flips_one_bit(desk: Desk) -> None:
    (good,) = desk.ask()
    desk.bench.trouble.add(Corrupt(motor_id=MOTOR, probability=1.0))
    (bad,) = desk.ask()
    assert (int.from_bytes(good.data, "big") ^ int.from_bytes(bad.data, "big")).bit_count() == 1


def test_a_stuck_joint_does_not_move(desk: Desk) -> None:
    trouble = Stuck(motor_id=MOTOR)
    desk.bench.trouble.add(trouble)
    desk.ask(encode_special(Special.ENABLE))
    push = encode_mit(MitCommand(0.0, 0.0, 0.0, 0.0, 3.0), desk.drive.ranges)
    start = desk.drive.shaft.state()[0]
    for _ in range(60):
        desk.ask(push)
    assert desk.drive.shaft.state()[0] == pytest.approx(start, abs=1e-3)
    desk.bench.trouble.remove(trouble)
    for _ in range(60):
        desk.ask(push)
    assert desk.drive.shaft.state()[0] > start + 0.05


def test_a_runaway_heeds_nobody(desk: Desk) -> None:
    desk.ask(encode_special(Special.ENABLE))
    start = desk.drive.shaft.state()[0]
    trouble = Runaway(motor_id=MOTOR, torque=3.0)
    desk.bench.trouble.add(trouble)
    for _ in range(60):
        desk.ask(encode_mit(MitCommand(start, 0.0, 50.0, 1.0, 0.0), desk.drive.ranges))
    assert desk.drive.shaft.state()[0] > start + 0.05
    desk.bench.trouble.remove(trouble)
    assert desk.drive.shaft.state()[2] == pytest.approx(3.0, abs=0.1)
    desk.ask()
    assert desk.drive.shaft.state()[2] == 0.0


def test_power_cut(desk: Desk) -> None:
    desk.ask(encode_special(Special.ENABLE))
    desk.ask(encode_register(MOTOR, RegisterCommand.WRITE, 9, (4000).to_bytes(4, "little")), BROADCAST_ID)
    desk.bench.trouble.add(PowerCut(from_ns=10 * MS, until_ns=20 * MS))
    answered = [bool(desk.ask()) for _ in range(30)]
    assert answered.count(False) == 10
    assert desk.status() == Status.DISABLED
    assert desk.drive.memory[Register.TIMEOUT] == 1600


def test_a_bus_without_power_acknowledges_nothing(desk: Desk) -> None:
    desk.ask()
    assert desk.errors == []
    desk.bench.trouble.add(PowerCut())
    assert desk.ask() == []
    assert desk.errors == [ERROR_CONTROLLER, UNACKNOWLEDGED.error_class]


def test_a_drive_at_another_bit_rate_breaks_frames_on_the_wire(desk: Desk) -> None:
    desk.drive.preset(Register.CAN_BR, 3)
    assert desk.ask() == []
    assert desk.errors == [GARBLED.error_class]
    desk.bench.nominal = 500_000
    assert len(desk.ask()) == 1


def test_without_termination_frames_are_lost_and_the_controller_says_so(desk: Desk) -> None:
    desk.bench.trouble.add(Unterminated(probability=0.3))
    lost = [not desk.ask() for _ in range(300)].count(True)
    assert 110 < lost < 200  # half of them: 0.7 times 0.7 get through
    assert desk.errors == [GARBLED.error_class] * lost


def test_under_voltage_cannot_be_cleared_until_the_supply_is_back(desk: Desk) -> None:
    sag = UnderVoltage(motor_id=MOTOR, voltage=11.0)
    desk.bench.trouble.add(sag)
    desk.ask(encode_special(Special.CLEAR_ERROR))
    assert desk.status() == Status.UNDER_VOLTAGE
    desk.bench.trouble.remove(sag)
    desk.ask(encode_special(Special.CLEAR_ERROR))
    assert desk.status() == Status.DISABLED


def test_a_wrong_zero_shifts_what_is_reported_and_not_the_shaft(desk: Desk) -> None:
    def reported() -> float:
        return decode_feedback(desk.ask()[0].data, desk.drive.ranges).position

    before, shaft = reported(), desk.drive.shaft.state()[0]
    desk.bench.trouble.add(WrongZero(motor_id=MOTOR, offset=0.5))
    assert reported() - before == pytest.approx(0.5, abs=5e-3)
    assert desk.drive.shaft.state()[0] == pytest.approx(shaft, abs=5e-3)


def test_failure(desk: Desk) -> None:
    desk.ask(encode_special(Special.ENABLE))
    desk.bench.trouble.add(Failure(motor_id=MOTOR, status=Status.OVERLOAD, from_ns=5 * MS))
    assert desk.status() == Status.ENABLED
    desk.clock.sleep_until(6 * MS)
    assert desk.status() == Status.OVERLOAD


@pytest.mark.parametrize(
    ("order", "trouble"),
    [
        ("mute:3", Mute(motor_id=3)),
        ("mute:0x03@1.5", Mute(motor_id=3, from_ns=1_500 * MS)),
        ("stuck:panda_joint2", Stuck(motor_id=2)),
        ("drop:7:0.25@1-2", Drop(motor_id=7, probability=0.25, from_ns=1000 * MS, until_ns=2000 * MS)),
        ("delay:7:0.004", Delay(motor_id=7, delay_s=0.004)),
        ("fault:gripper:0xC", Failure(motor_id=8, status=0xC)),
    ],
)
def test_orders(desk: Desk, order: str, trouble) -> None:
    planted = []
    desk.bench.trouble.add = planted.append
    order_trouble(desk.bench, order)
    assert planted == [trouble]


def test_orders_for_all(desk: Desk) -> None:
    order_trouble(desk.bench, "mute:all")
    assert len(desk.bench.trouble.active) == 8


@pytest.mark.parametrize(
    "order", ["", "mute", "boom:3", "mute:99", "mute:nobody", "mute:3:1", "drop:3:often", "drop:3:1:2", "mute:3@soon"]
)
def test_orders_that_make_no_sense(desk: Desk, order: str) -> None:
    with pytest.raises(ConfigError):
        order_trouble(desk.bench, order)


def test_register_presets(desk: Desk) -> None:
    order_register(desk.bench, "3:TIMEOUT=0")
    order_register(desk.bench, "panda_joint4:21=3.5")
    order_register(desk.bench, "all:sw_ver=0x10")
    assert desk.bench.drive(3).memory[Register.TIMEOUT] == 0
    assert desk.bench.drive(4).ranges.pmax == 3.5
    assert all(drive.memory[Register.SW_VER] == 16 for drive in desk.bench.drives)
    desk.bench.drive(3).power_up()
    assert desk.bench.drive(3).memory[Register.TIMEOUT] == 0
    assert desk.bench.drive(3).memory.cycles == 0


@pytest.mark.parametrize("order", ["", "3", "3:9", "3:9=x", "3:99=1", "3:nothing=1", "99:9=1", "3:10=7", "3:21=-1"])
def test_register_presets_that_make_no_sense(desk: Desk, order: str) -> None:
    with pytest.raises(ConfigError):
        order_register(desk.bench, order)


def test_misreport_shifts_the_angle_and_nothing_else(desk: Desk) -> None:
    before = decode_feedback(desk.ask()[0].data, desk.drive.ranges)
    desk.bench.trouble.add(Misreport(motor_id=MOTOR, offset=0.5, tell=desk.drive.shifted))
    after = decode_feedback(desk.ask()[0].data, desk.drive.ranges)
    assert after.position == pytest.approx(before.position + 0.5, abs=1e-3)
    assert after._replace(position=before.position) == before
    request = encode_register(MOTOR, RegisterCommand.READ, Register.PMAX)
    assert desk.ask(request, BROADCAST_ID)[0].data[2] == RegisterCommand.READ


def test_short_replies(desk: Desk) -> None:
    desk.bench.trouble.add(Short(motor_id=MOTOR, length=5))
    assert len(desk.ask()[0].data) == 5


@pytest.mark.parametrize("part", [0.5, -1.0])
def test_a_weak_drive_applies_a_part_of_its_torque(desk: Desk, part: float) -> None:
    desk.ask(encode_special(Special.ENABLE))
    push = encode_mit(MitCommand(0.0, 0.0, 0.0, 0.0, 2.0), desk.drive.ranges)
    weak = Weak(motor_id=MOTOR, part=part)
    desk.bench.trouble.add(weak)
    desk.ask(push)
    desk.ask(push)
    assert desk.drive.shaft.state()[2] == pytest.approx(2.0 * part, abs=0.02)
    desk.bench.trouble.remove(weak)
    desk.ask(push)
    desk.ask(push)
    assert desk.drive.shaft.state()[2] == pytest.approx(2.0, abs=0.02)


def test_a_bus_that_fails_and_one_that_reports_errors(desk: Desk) -> None:
    desk.bus.report(0x40)
    frames = desk.ask()
    assert len(frames) == 1
    assert desk.errors == [0x40]
    desk.bus.failure = can.CanOperationError("unplugged")
    with pytest.raises(can.CanOperationError, match="unplugged"):
        desk.ask()
    desk.bus.failure = None
    assert len(desk.ask()) == 1
