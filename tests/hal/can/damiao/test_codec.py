import math
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from robotctl.hal.can.damiao.codec import (
    KD_MAX,
    KP_MAX,
    Feedback,
    MitCommand,
    PosForceCommand,
    PosVelCommand,
    RegisterCommand,
    Special,
    Status,
    decode_feedback,
    decode_mit,
    decode_pos_force,
    decode_pos_vel,
    decode_register,
    decode_vel,
    encode_feedback,
    encode_mit,
    encode_pos_force,
    encode_pos_vel,
    encode_register,
    encode_special,
    encode_vel,
    is_feedback,
    quantise,
)
from robotctl.hal.can.damiao.motors import MOTORS, Ranges

DM4310 = MOTORS["DM4310"]
DM4340 = MOTORS["DM4340"]
DM8009 = MOTORS["DM8009"]

# Worked by hand: u = (x - min) / (max - min) * (2^N - 1), rounded to the nearest step; see the module's docstring.
MIT_VECTORS = [
    # 0 lies between two steps of every signed field: 32767.5 rounds to 0x8000, 2047.5 to 0x800.
    (DM4310, MitCommand(0.0, 0.0, 0.0, 0.0, 0.0), "8000 8000 0000 0800"),
    # p (1+12.5)/25*65535 = 35388.9, v (0.5+45)/90*4095 = 2070.25, kp 70/500*4095 = 573.3, kd 2252.25, t 2161.25
    (DM8009, MitCommand(1.0, 0.5, 70.0, 2.75, 3.0), "8A3D 8162 3D8C C871"),
    # p (-0.8+12.5)/25*65535 = 30670.38, v 9/20*4095 = 1842.75, kp 491.4, kd 1638, t 22.5/56*4095 = 1645.3
    (DM4340, MitCommand(-0.8, -1.0, 60.0, 2.0, -5.5), "77CE 7331 EB66 666D"),
    (DM4310, MitCommand(-12.5, -30.0, 0.0, 0.0, -10.0), "0000 0000 0000 0000"),
    (DM4310, MitCommand(12.5, 30.0, 500.0, 5.0, 10.0), "FFFF FFFF FFFF FFFF"),
]


@pytest.mark.parametrize(("ranges", "command", "expected"), MIT_VECTORS)
def test_mit_golden(ranges: Ranges, command: MitCommand, expected: str) -> None:
    assert encode_mit(command, ranges) == bytes.fromhex(expected)


@pytest.mark.parametrize(
    ("ranges", "truncated", "command"),
    [
        (DM4310, "7FFF 7FF0 0000 07FF", MitCommand(0.0, 0.0, 0.0, 0.0, 0.0)),
        (DM8009, "8A3C 8162 3D8C C871", MitCommand(1.0, 0.5, 70.0, 2.75, 3.0)),
        (DM4340, "77CE 7321 EB66 666D", MitCommand(-0.8, -1.0, 60.0, 2.0, -5.5)),
    ],
)
def test_frames_of_hosts_that_truncate_decode_within_one_step(ranges, truncated, command) -> None:
    decoded = decode_mit(bytes.fromhex(truncated), ranges)
    for value, wanted, step in zip(decoded, command, _mit_steps(ranges), strict=True):
        assert abs(value - wanted) <= step * (1.0 + 1e-9)


def test_feedback_golden() -> None:
    data = bytes.fromhex("118A3D8178711E1C")
    feedback = decode_feedback(data, DM8009)
    assert feedback.motor == 1
    assert feedback.status == Status.ENABLED
    assert feedback.position == pytest.approx(1.00004, abs=1e-5)
    assert feedback.velocity == pytest.approx(0.5165, abs=1e-4)
    assert feedback.effort == pytest.approx(2.9934, abs=1e-4)
    assert (feedback.mosfet_temperature, feedback.rotor_temperature) == (30, 28)
    assert encode_feedback(feedback, DM8009) == data


def test_float_frames_golden() -> None:
    assert encode_pos_vel(PosVelCommand(1.0, 2.0)) == bytes.fromhex("0000803F00000040")
    assert encode_pos_force(PosForceCommand(0.5, 5.0, 0.3)) == bytes.fromhex("0000003FF401B80B")
    assert encode_vel(-1.0) == bytes.fromhex("000080BF")
    assert decode_pos_vel(bytes.fromhex("0000803F00000040")) == (1.0, 2.0)
    assert decode_pos_force(bytes.fromhex("0000003FF401B80B")) == (0.5, 5.0, 0.3)
    # Hosts send VEL with 4 bytes, or padded to 8.
    assert decode_vel(bytes.fromhex("000080BF")) == decode_vel(bytes.fromhex("000080BF00000000")) == -1.0


@pytest.mark.parametrize(
    ("command", "last"),
    [(Special.CLEAR_ERROR, "FB"), (Special.ENABLE, "FC"), (Special.DISABLE, "FD"), (Special.SET_ZERO, "FE")],
)
def test_special_golden(command: Special, last: str) -> None:
    assert encode_special(command) == bytes.fromhex("FFFFFFFFFFFFFF" + last)


def test_register_golden() -> None:
    assert encode_register(1, RegisterCommand.READ, 21) == bytes.fromhex("0100331500000000")
    # i2rt's watchdog of 400 ms
    assert encode_register(7, RegisterCommand.WRITE, 9, struct.pack("<I", 8000)) == bytes.fromhex("07005509401F0000")
    assert encode_register(1, RegisterCommand.SAVE, 1) == bytes.fromhex("0100AA0100000000")
    assert encode_register(0x123, RegisterCommand.REFRESH) == bytes.fromhex("2301CC0000000000")


def test_register_frames_are_for_one_motor() -> None:
    data = bytes.fromhex("07005509401F0000")
    assert decode_register(data, 7) == (7, RegisterCommand.WRITE, 9, b"\x40\x1f\0\0")
    assert decode_register(data, 8) is None
    assert decode_register(bytes.fromhex("0700AA01"), 7) == (7, RegisterCommand.SAVE, 1, b"\0\0\0\0")
    assert decode_register(bytes.fromhex("0700"), 7) is None
    assert decode_register(b"", 7) is None
    assert decode_register(bytes.fromhex("0700560900000000"), 7) is None


@pytest.mark.parametrize("command", list(RegisterCommand))
def test_register_replies_are_not_feedback(command: RegisterCommand) -> None:
    reply = encode_register(3, command, 10, struct.pack("<I", 1))
    assert not is_feedback(reply, 3)
    # What it would have been: a position within a tenth of a radian of -PMAX.
    assert -12.5 <= decode_feedback(reply, DM4310).position < -12.4


def test_feedback_that_resembles_a_register_reply_in_one_byte_is_feedback() -> None:
    # The low byte of a position takes each of these values; only together with bytes 0 and 1 do they mean a register.
    for low in RegisterCommand:
        assert is_feedback(bytes((0x13, 0x80, low, 0x80, 0x08, 0x00, 25, 25)), 3)
    # Same bytes, but a fault in the status nibble.
    assert is_feedback(bytes((0xD3, 0x00, 0x55, 0x0A, 0, 0, 25, 25)), 3)
    # A register number that does not exist.
    assert is_feedback(bytes((0x03, 0x00, 0x55, 0x52, 0, 0, 25, 25)), 3)


def test_feedback_of_another_motor_or_length_is_refused() -> None:
    good = bytes((0x13, 0x80, 0, 0x80, 0x08, 0x00, 25, 25))
    assert is_feedback(good, 3)
    assert is_feedback(good, 0x13)
    assert not is_feedback(good, 4)
    assert not is_feedback(good[:7], 3)
    assert not is_feedback(b"", 3)


@given(st.sampled_from(sorted(MOTORS)), st.data())
def test_mit_round_trip_within_half_a_step(motor: str, data: st.DataObject) -> None:
    ranges = MOTORS[motor]
    lows = (-ranges.pmax, -ranges.vmax, 0.0, 0.0, -ranges.tmax)
    highs = (ranges.pmax, ranges.vmax, KP_MAX, KD_MAX, ranges.tmax)
    command = MitCommand(*(data.draw(st.floats(low, high)) for low, high in zip(lows, highs, strict=True)))
    decoded = decode_mit(encode_mit(command, ranges), ranges)
    for value, wanted, step in zip(decoded, command, _mit_steps(ranges), strict=True):
        assert abs(value - wanted) <= 0.5 * step * (1.0 + 1e-9)


@given(
    st.sampled_from(sorted(MOTORS)),
    st.integers(0, 15),
    st.integers(0, 15),
    st.floats(-2.0, 2.0),
    st.floats(-2.0, 2.0),
    st.floats(-2.0, 2.0),
    st.integers(0, 255),
    st.integers(0, 255),
)
def test_feedback_round_trip_clips_and_rounds(motor, low_id, status, p, v, t, mosfet, rotor) -> None:
    ranges = MOTORS[motor]
    sent = Feedback(low_id, status, p * ranges.pmax, v * ranges.vmax, t * ranges.tmax, mosfet, rotor)
    got = decode_feedback(encode_feedback(sent, ranges), ranges)
    assert (got.motor, got.status, got.mosfet_temperature, got.rotor_temperature) == (low_id, status, mosfet, rotor)
    for value, wanted, top, bits in zip(got[2:5], sent[2:5], ranges, (16, 12, 12), strict=True):
        clipped = min(max(wanted, -top), top)
        assert abs(value - clipped) <= top / (2**bits - 1) * (1.0 + 1e-9)


@given(st.binary(min_size=8, max_size=8))
def test_every_frame_decodes_and_mit_encodes_back(data: bytes) -> None:
    assert encode_mit(decode_mit(data, DM4340), DM4340) == data
    assert encode_feedback(decode_feedback(data, DM4340), DM4340) == data


@given(st.floats(allow_nan=False))
def test_quantise_stays_in_its_field(value: float) -> None:
    assert 0 <= quantise(value, -12.5, 12.5, 0xFFFF) <= 0xFFFF


def test_pos_force_clips() -> None:
    assert decode_pos_force(encode_pos_force(PosForceCommand(0.0, 1e9, math.inf))) == (0.0, 100.0, 1.0)
    assert decode_pos_force(encode_pos_force(PosForceCommand(0.0, -1.0, -1.0))) == (0.0, 0.0, 0.0)


def _mit_steps(ranges: Ranges) -> tuple[float, ...]:
    return 2 * ranges.pmax / 0xFFFF, 2 * ranges.vmax / 0xFFF, KP_MAX / 0xFFF, KD_MAX / 0xFFF, 2 * ranges.tmax / 0xFFF
