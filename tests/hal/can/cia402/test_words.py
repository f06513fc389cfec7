"""Frames in words, and recorded frames decoded again."""

import json

import pytest

from robotctl.hal.can.cia402.replay import Replayed402, describe
from robotctl.hal.can.cia402.words import Words402
from robotctl.hal.can.monitor import words_of
from robotctl.hal.robot import Robot


@pytest.mark.parametrize(
    ("identifier", "data", "text"),
    [
        (0x080, "", "SYNC"),
        (0x000, "01 03", "to joint3: NMT START"),
        (0x000, "81 00", "to all: NMT RESET NODE"),
        (0x77F, "05", "host: OPERATIONAL"),
        (0x701, "7f", "joint1: PRE OPERATIONAL"),
        (0x201, "0f 00 08 bb d4 1f 00", "to joint1: ENABLE OPERATION, POSITION, 1.0000 rad"),
        (0x302, "bb d4 1f 00 64 00", "to joint2: -1.000 rad/s, -3.50 Nm"),
        (0x181, "37 12 00 00 00 00 fa 00", "joint1: OPERATION ENABLED, 0.0000 rad, 8.75 Nm"),
        (0x281, "00 00 00 00 0a", "joint1: 0.000 rad/s, TORQUE"),
        (0x084, "11 86 21 00 00 00 00 00", "joint4: EMCY FOLLOWING_ERROR"),
        (0x084, "00 00 00 00 00 00 00 00", "joint4: EMCY cause has gone"),
        (0x601, "40 41 60 00 00 00 00 00", "to joint1: SDO read 0x6041:0 statusword"),
        (0x581, "4b 41 60 00 50 02 00 00", "joint1: SDO is 0x6041:0 statusword 0x250"),
        (0x587, "80 99 99 00 00 00 02 06", "joint7: SDO abort 0x9999:0 0x6020000"),
        (0x201, "0f 00", "joint1: 2 bytes that make no sense"),
        (0x601, "", "joint1: 0 bytes that make no sense"),
        (0x209, "00", "?"),
        (0x481, "00", "?"),
    ],
)
def test_what_a_frame_says(xarm7: Robot, identifier: int, data: str, text: str):
    assert Words402(xarm7)(identifier, bytes.fromhex(data)) == text


def test_the_monitor_knows_the_protocol(xarm7: Robot):
    assert isinstance(words_of(xarm7), Words402)


def test_recorded_frames_are_decoded_as_they_were(desk):
    frames = []

    class Tap:
        description = None

        def sent(self, *_):
            pass

        def received(self, frame, stamp_ns):
            frames.append((frame.arbitration_id, bytes(frame.data), stamp_ns))

        def describe(self, description):
            Tap.description = json.loads(json.dumps(description))

    desk.arm.record_frames(Tap())
    desk.enable()
    desk.tick(20, desk.hold())
    replayed = Replayed402(Tap.description)
    for frame in frames:
        replayed.accept(*frame)
    position, velocity, effort = replayed.state()
    latest = desk.arm.read()
    assert position.tolist() == latest.position.tolist()
    assert velocity.tolist() == latest.velocity.tolist()
    assert effort.tolist() == latest.effort.tolist()
    assert describe(desk.arm._drives) == Tap.description
