"""Others on the bus, as the host hears them."""

import can
import pytest

from robotctl.hal.can.damiao.codec import RegisterCommand, decode_feedback, is_feedback
from robotctl.hal.clock import VirtualClock
from robotctl.hal.robot import Robot
from robotctl.sim.motors.bench import Bench
from robotctl.sim.motors.bus import EmulatedBus
from robotctl.sim.motors.strangers import Babble, Chatter, Impostor
from robotctl.sim.motors.trouble import Trouble

MOTOR = 3


def answers(robot: Robot, trouble: Trouble, motor: int = MOTOR) -> list[tuple[int, bytes]]:
    bench = Bench(robot)
    bench.trouble.add(trouble)
    bus = EmulatedBus(bench, VirtualClock())
    bus.send(can.Message(arbitration_id=motor, is_extended_id=False, data=bytes(8)))
    return [(frame.arbitration_id, bytes(frame.data)) for frame in iter(lambda: bus.recv(0.0), None)]


def test_a_babbling_node_sends_beside_every_answer(panda: Robot) -> None:
    found = answers(panda, Babble(motor_id=MOTOR, frames=2))
    assert [identifier for identifier, _ in found] == [0x13, 0x055, 0x055]
    assert found[1] != found[2]
    assert len(answers(panda, Babble(motor_id=MOTOR), motor=4)) == 1


def test_an_impostor_answers_from_elsewhere_on_the_same_id(panda: Robot) -> None:
    drive = Bench(panda).drive(MOTOR)
    ranges = drive.ranges
    (one, ours), (other, theirs) = answers(panda, Impostor(motor_id=MOTOR, offset=0.5, tell=drive.shifted))
    assert one == other == 0x13
    ours, theirs = decode_feedback(ours, ranges), decode_feedback(theirs, ranges)
    assert theirs.position - ours.position == pytest.approx(0.5, abs=1e-3)
    assert theirs.status == ours.status


def test_chatter_brings_acknowledgements_that_are_no_feedback(panda: Robot) -> None:
    (_, ours), (identifier, other) = answers(panda, Chatter(motor_id=MOTOR))
    assert is_feedback(ours, MOTOR)
    assert identifier == 0x13
    assert not is_feedback(other, MOTOR)
    assert other[2] == RegisterCommand.READ
