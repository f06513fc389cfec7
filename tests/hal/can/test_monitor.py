"""Listening: rates, meanings, changes, and never a word."""

import can
import pytest

from robotctl.hal.can.channel import Channel
from robotctl.hal.can.damiao.codec import (
    Feedback,
    MitCommand,
    PosForceCommand,
    RegisterCommand,
    Special,
    encode_feedback,
    encode_mit,
    encode_pos_force,
    encode_register,
    encode_special,
)
from robotctl.hal.can.damiao.motors import MOTORS
from robotctl.hal.can.damiao.registers import Register, encode_value
from robotctl.hal.can.damiao.words import DamiaoWords
from robotctl.hal.can.monitor import Monitor, listen, open_listening
from robotctl.hal.clock import VirtualClock
from robotctl.hal.errors import BusError, ConfigError
from robotctl.hal.robot import load_robot

ROBOT = load_robot("openarm")
DM4310 = MOTORS["DM4310"]
SECOND = 10**9


def frame(arbitration_id, data=bytes(8), **flags):
    return can.Message(arbitration_id=arbitration_id, data=data, is_extended_id=flags.pop("extended", False), **flags)


class CountingBus(can.BusABC):
    """Hands out frames, one per 10 ms of the clock, and counts what is sent."""

    def __init__(self, clock, frames):
        self.sent = 0
        self._clock, self._frames = clock, list(frames)
        super().__init__("counting")

    def send(self, msg, timeout=None):
        self.sent += 1

    def _recv_internal(self, timeout):
        self._clock.sleep_until(self._clock.now_ns() + SECOND // 100)
        item = self._frames.pop(0) if self._frames else None
        if isinstance(item, Exception):
            raise item
        return item, True


def hear(frames, seconds=3):
    clock = VirtualClock()
    bus, monitor = CountingBus(clock, frames), Monitor(DamiaoWords(ROBOT), 0)
    seen = []
    channel = Channel(bus, fd=True)
    listen(
        channel, monitor, clock, seconds * SECOND, lambda: seen.append({r.arbitration_id: r.rate for r in monitor.rows})
    )
    channel.close()
    return bus, monitor, seen


def test_nothing_is_ever_sent_whatever_is_heard():
    questions = [frame(0x7FF, encode_register(3, RegisterCommand.READ, 9)), frame(3)]
    questions += [
        frame(5, dlc=8, is_remote_frame=True, data=None),
        frame(0x80, is_error_frame=True),
        frame(1, extended=True),
    ]
    bus, monitor, _ = hear(questions * 20)
    assert monitor.frames == 80
    assert monitor.error_frames == 20
    assert bus.sent == 0


def test_rates_are_those_of_the_latest_second():
    _, monitor, seen = hear([frame(0x11), frame(0x12)] * 40 + [frame(0x12)] * 20 + [frame(0x12)] * 100)
    assert seen[0] == pytest.approx({0x11: 40.0, 0x12: 60.0}, rel=0.03)
    assert seen[1] == pytest.approx({0x11: 0.0, 0x12: 100.0}, rel=0.03)
    assert [row.frames for row in monitor.rows] == [40, 160]


def test_the_last_change_is_that_of_the_data():
    monitor = Monitor(DamiaoWords(ROBOT), 0)
    for number, data in enumerate([b"\x01" * 8, b"\x01" * 8, b"\x02" * 8, b"\x02" * 8]):
        monitor.take(frame(0x100, data), number)
    assert monitor.rows[0].changed_ns == 2


@pytest.mark.parametrize(
    ("arbitration_id", "data", "words"),
    [
        (5, encode_special(Special.ENABLE), "to openarm_right_joint5: ENABLE"),
        (5, encode_mit(MitCommand(1.0, 0.0, 30.0, 1.0, 0.5), DM4310), "MIT +1.000 rad"),
        (
            0x308,
            encode_pos_force(PosForceCommand(0.5, 2.0, 0.3)),
            "gripper: POS_FORCE +0.500 rad up to 2.00 rad/s, 30%",
        ),
        (0x15, encode_feedback(Feedback(5, 1, 1.0, 0.0, 0.0, 30, 28), DM4310), "joint5: ENABLED +1.000 rad"),
        (0x15, encode_feedback(Feedback(5, 9, 1.0, 0.0, 0.0, 30, 28), DM4310), "UNDER_VOLTAGE"),
        (
            0x7FF,
            encode_register(5, RegisterCommand.READ, Register.TIMEOUT),
            "to openarm_right_joint5: what is TIMEOUT?",
        ),
        (
            0x15,
            encode_register(5, RegisterCommand.READ, Register.TIMEOUT, encode_value(Register.TIMEOUT, 1600)),
            "openarm_right_joint5: TIMEOUT = 1600",
        ),
        (0x7FF, encode_register(5, RegisterCommand.SAVE, 1), "STORE all registers"),
        (0x7FF, encode_register(99, RegisterCommand.REFRESH), "to motor 0x63: how are you?"),
        (0x15, bytes(3), "?"),
        (0x222, bytes(8), "?"),
    ],
)
def test_frames_in_words(arbitration_id, data, words):
    assert words in DamiaoWords(ROBOT)(arbitration_id, data)


def test_a_channel_that_stays_broken_ends_it():
    with pytest.raises(BusError, match="gone"):
        hear([can.CanOperationError("unplugged")] * 30)
    hear([can.CanOperationError("noise")] * 5 + [frame(1)])


def test_where_nobody_else_speaks_there_is_nothing_to_hear():
    with pytest.raises(ConfigError, match="nothing can be overheard"):
        open_listening("emulated", ROBOT)
    with pytest.raises(ConfigError, match="no CAN drives"):
        open_listening("virtual:x", load_robot("kinova"))
