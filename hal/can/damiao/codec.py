"""DAMIAO frames: bytes to values and back. Pure functions, no I/O, no clock.

Scaling, all fields: u = (x - min) / (max - min) * (2^bits - 1), big-endian in MIT frames and feedback, with the
ranges PMAX, VMAX and TMAX of the drive (registers 21 to 23); kp spans 0..500 and kd 0..5. The host rounds to the
nearest step; openarm_can and axol truncate, so a peer may differ by one step. Zero is not representable.
Float payloads and registers are little-endian.
"""

import struct
from enum import IntEnum
from typing import NamedTuple

from robotctl.hal.can.damiao.motors import Ranges

KP_MAX = 500.0
KD_MAX = 5.0
BROADCAST_ID = 0x7FF
"""Register traffic goes here; the addressed motor's id is in the payload."""

_U16 = 0xFFFF
_U12 = 0xFFF


class Offset(IntEnum):
    """What a command id adds to the motor's id, by control mode."""

    MIT = 0x000
    POS_VEL = 0x100
    VEL = 0x200
    POS_FORCE = 0x300


class Special(IntEnum):
    """Last byte of the frames FF FF FF FF FF FF FF xx."""

    CLEAR_ERROR = 0xFB
    ENABLE = 0xFC
    DISABLE = 0xFD
    SET_ZERO = 0xFE


class RegisterCommand(IntEnum):
    """Third byte of a register frame."""

    READ = 0x33
    WRITE = 0x55
    SAVE = 0xAA
    REFRESH = 0xCC


class Status(IntEnum):
    """High nibble of feedback byte 0. Codes that are not listed are passed on as plain integers."""

    DISABLED = 0x0
    ENABLED = 0x1
    SENSOR_ERROR = 0x5
    PARAMETER_ERROR = 0x6
    OVER_VOLTAGE = 0x8
    UNDER_VOLTAGE = 0x9
    OVER_CURRENT = 0xA
    MOSFET_OVER_TEMPERATURE = 0xB
    ROTOR_OVER_TEMPERATURE = 0xC
    COMMUNICATION_LOST = 0xD
    OVERLOAD = 0xE


class MitCommand(NamedTuple):
    """torque = kp (position - q) + kd (velocity - dq) + effort, in motor coordinates."""

    position: float
    """rad"""
    velocity: float
    """rad/s"""
    kp: float
    """Nm/rad"""
    kd: float
    """Nms/rad"""
    effort: float
    """Nm"""


class PosVelCommand(NamedTuple):
    """Go to a position, no faster than a speed."""

    position: float
    """rad"""
    velocity: float
    """rad/s, a limit"""


class PosForceCommand(NamedTuple):
    """Go to a position with limited speed and current."""

    position: float
    """rad"""
    velocity: float
    """rad/s, a limit; 0..100 in steps of 0.01"""
    current: float
    """fraction of the largest current; 0..1 in steps of 0.0001"""


class Feedback(NamedTuple):
    """What a motor answers to every command."""

    motor: int
    """Low nibble of the motor's id."""
    status: int
    """See `Status`."""
    position: float
    """rad"""
    velocity: float
    """rad/s"""
    effort: float
    """Nm"""
    mosfet_temperature: int
    """degrees Celsius"""
    rotor_temperature: int
    """degrees Celsius"""


class RegisterFrame(NamedTuple):
    """A register request, or the reply to one: `raw` are the four value bytes."""

    motor: int
    command: int
    register: int
    raw: bytes


def quantise(value: float, low: float, high: float, top: int) -> int:
    """Return the step 0..`top` nearest to `value`; values outside the range become its ends."""
    if value <= low:
        return 0
    if value >= high:
        return top
    return int((value - low) * top / (high - low) + 0.5)


def encode_mit(command: MitCommand, ranges: Ranges) -> bytes:
    """Return the 8 bytes of an MIT command."""
    position, velocity, kp, kd, effort = command
    pmax, vmax, tmax = ranges
    return (
        quantise(position, -pmax, pmax, _U16) << 48
        | quantise(velocity, -vmax, vmax, _U12) << 36
        | quantise(kp, 0.0, KP_MAX, _U12) << 24
        | quantise(kd, 0.0, KD_MAX, _U12) << 12
        | quantise(effort, -tmax, tmax, _U12)
    ).to_bytes(8, "big")


def decode_mit(data: bytes, ranges: Ranges) -> MitCommand:
    """Return the command in 8 bytes, as the motor understands it."""
    word = int.from_bytes(data[:8], "big")
    pmax, vmax, tmax = ranges
    return MitCommand(
        (word >> 48) * (2.0 * pmax / _U16) - pmax,
        (word >> 36 & _U12) * (2.0 * vmax / _U12) - vmax,
        (word >> 24 & _U12) * (KP_MAX / _U12),
        (word >> 12 & _U12) * (KD_MAX / _U12),
        (word & _U12) * (2.0 * tmax / _U12) - tmax,
    )


def encode_feedback(feedback: Feedback, ranges: Ranges) -> bytes:
    """Return the 8 bytes of a feedback frame."""
    pmax, vmax, tmax = ranges
    return (
        (feedback.status & 0xF) << 60
        | (feedback.motor & 0xF) << 56
        | quantise(feedback.position, -pmax, pmax, _U16) << 40
        | quantise(feedback.velocity, -vmax, vmax, _U12) << 28
        | quantise(feedback.effort, -tmax, tmax, _U12) << 16
        | (feedback.mosfet_temperature & 0xFF) << 8
        | (feedback.rotor_temperature & 0xFF)
    ).to_bytes(8, "big")


def decode_feedback(data: bytes, ranges: Ranges) -> Feedback:
    """Return the feedback in 8 bytes. Ask `is_feedback` first."""
    word = int.from_bytes(data[:8], "big")
    pmax, vmax, tmax = ranges
    return Feedback(
        word >> 56 & 0xF,
        word >> 60,
        (word >> 40 & _U16) * (2.0 * pmax / _U16) - pmax,
        (word >> 28 & _U12) * (2.0 * vmax / _U12) - vmax,
        (word >> 16 & _U12) * (2.0 * tmax / _U12) - tmax,
        word >> 8 & 0xFF,
        word & 0xFF,
    )


def is_feedback(data: bytes, motor: int) -> bool:
    """Return whether a frame on a motor's reply id is feedback, and not a register reply that looks like it.

    A write acknowledgement read as feedback is a position of -12.47 rad. It is told apart by its bytes 0 to 3:
    the motor's id, a register command and a register number; a true position matches those only by a fault nibble
    of zero together with a position within a few millirad of -PMAX.
    """
    if len(data) != 8 or data[0] & 0xF != motor & 0xF:
        return False
    return not (data[0] == motor & 0xFF and data[1] == motor >> 8 and data[2] in _REGISTER_COMMANDS and data[3] <= 81)


def decode_register(data: bytes, motor: int) -> RegisterFrame | None:
    """Return the register frame in `data` if it is one of, or for, this motor; else None."""
    if len(data) < 4 or data[0] | data[1] << 8 != motor or data[2] not in _REGISTER_COMMANDS:
        return None
    return RegisterFrame(motor, data[2], data[3], bytes(data[4:8]).ljust(4, b"\0"))


def encode_register(motor: int, command: RegisterCommand, register: int = 0, raw: bytes = b"\0\0\0\0") -> bytes:
    """Return the 8 bytes of a register request (on BROADCAST_ID) or reply (on the motor's reply id)."""
    return bytes((motor & 0xFF, motor >> 8, command, register)) + raw


def encode_special(command: Special) -> bytes:
    """Return enable, disable, set-zero or clear-error, sent to the motor's id."""
    return b"\xff\xff\xff\xff\xff\xff\xff" + bytes((command,))


def encode_pos_vel(command: PosVelCommand) -> bytes:
    """Return the 8 bytes of a POS_VEL command."""
    return struct.pack("<ff", *command)


def decode_pos_vel(data: bytes) -> PosVelCommand:
    return PosVelCommand(*struct.unpack("<ff", data[:8]))


def encode_vel(velocity: float) -> bytes:
    """Return the 4 bytes of a VEL command, rad/s. Other hosts pad it with zeros to 8."""
    return struct.pack("<f", velocity)


def decode_vel(data: bytes) -> float:
    return float(struct.unpack("<f", data[:4])[0])


def encode_pos_force(command: PosForceCommand) -> bytes:
    """Return the 8 bytes of a POS_FORCE command."""
    return struct.pack(
        "<fHH",
        command.position,
        quantise(command.velocity, 0.0, 100.0, 10_000),
        quantise(command.current, 0.0, 1.0, 10_000),
    )


def decode_pos_force(data: bytes) -> PosForceCommand:
    position, velocity, current = struct.unpack("<fHH", data[:8])
    return PosForceCommand(position, velocity / 100.0, current / 10_000.0)


_REGISTER_COMMANDS = frozenset(RegisterCommand)
