"""What a scan saw, and what is made of it."""

import pytest

from robotctl.hal.can.damiao.drive import Identity
from robotctl.hal.can.damiao.motors import MOTORS
from robotctl.hal.can.error_frames import ErrorKind
from robotctl.hal.can.found import FoundMotor
from robotctl.hal.can.verdict import Attempt, bus_findings
from robotctl.hal.can.ways import Way
from robotctl.hal.host import Level

CLASSIC, FD, SLOW = Way(1_000_000, False), Way(1_000_000, True), Way(500_000, False)
IDENTITY = Identity(1, 0x11, 1, 5013, 1, 99, 1, 0.08, MOTORS["DM4310"])


def motor(motor_id=1, heard=10, identity=IDENTITY):
    return FoundMotor(motor_id, (0x10 + motor_id,), identity, asked=10, heard=heard)


def attempt(motors=(), way=CLASSIC, errors=None, **statistics):
    return Attempt(way, tuple(motors), statistics, errors or {}, 32)


def judge(*attempts, blind=""):
    return [(finding.name, finding.level) for finding in bus_findings(attempts, blind)]


def test_a_sound_bus_is_told_in_one_line():
    assert judge(attempt([motor(1), motor(2)])) == [("answers", Level.OK)]


@pytest.mark.parametrize(
    ("errors", "statistics", "name"),
    [
        ({ErrorKind.NO_ACK: 30}, {}, "power"),
        ({}, {"send_failures": 3}, "power"),
        ({ErrorKind.GARBLED: 30, ErrorKind.NO_ACK: 2}, {}, "bit rate"),
        ({}, {}, "silence"),
    ],
)
def test_silence_has_reasons(errors, statistics, name):
    assert judge(attempt(errors=errors, **statistics)) == [(name, Level.FAIL)]


def test_silence_says_what_was_tried_and_what_the_channel_cannot_show():
    first, sight = bus_findings([attempt(), attempt(way=SLOW)], "blind")
    assert "ids 1 to 32 (classic CAN at 1 Mbit/s, classic CAN at 500 kbit/s)" in first.text
    assert (sight.name, sight.level, sight.text) == ("sight", Level.OK, "blind")


@pytest.mark.parametrize(("way", "name"), [(SLOW, "bit rate"), (FD, "CAN FD")])
def test_who_answers_in_another_way_only(way, name):
    (finding,) = bus_findings([attempt(), attempt([motor(3)], way)], "")
    assert (finding.name, finding.level) == (name, Level.FAIL)
    assert finding.text.startswith("0x03: silent on classic CAN at 1 Mbit/s, but answers on")


def test_losses_of_all_are_the_bus_and_those_of_one_are_its_own():
    sound = [motor(motor_id) for motor_id in range(1, 6)]
    assert judge(attempt([motor(1, 6), motor(2, 7), motor(3, 9)])) == [("termination", Level.FAIL)]
    assert judge(attempt([*sound, motor(6, 5)])) == [("0x06", Level.WARN)]
    assert judge(attempt([*sound, motor(6, identity=None)])) == [("0x06", Level.WARN)]


def test_error_frames_without_losses_are_a_warning():
    assert judge(attempt([motor()], errors={ErrorKind.GARBLED: 4})) == [("errors", Level.WARN)]
