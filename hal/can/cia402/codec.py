"""Frames of a CiA 402 drive as this package maps them: bytes to values and back. Pure functions, little-endian.

Four PDOs per drive and SYNC (CiA 301): what is sent before a SYNC acts with it, what is measured at it comes after.

    RPDO1  0x200+id  0x6040 controlword u16 | 0x6060 mode i8 | 0x607A target position i32
    RPDO2  0x300+id  0x60B1 velocity offset i32 | 0x60B2 torque offset i16
    TPDO1  0x180+id  0x6041 statusword u16 | 0x6064 position i32 | 0x6077 torque i16
    TPDO2  0x280+id  0x606C velocity i32 | 0x6061 mode i8
"""

import struct
from enum import IntEnum
from typing import NamedTuple

HOST_ID = 127
"""Node id under which the host's heartbeat appears."""

SYNC_ID = 0x080
NMT_ID = 0x000


class Service(IntEnum):
    """What a node's id is added to: the predefined connection set of CiA 301."""

    EMCY = 0x080
    TPDO1 = 0x180
    RPDO1 = 0x200
    TPDO2 = 0x280
    RPDO2 = 0x300
    SDO_REPLY = 0x580
    SDO = 0x600
    HEARTBEAT = 0x700


class Mode(IntEnum):
    """Modes of operation, objects 0x6060 and 0x6061."""

    NONE = 0
    POSITION = 8
    """Cyclic synchronous position (CSP)."""
    VELOCITY = 9
    """Cyclic synchronous velocity (CSV)."""
    TORQUE = 10
    """Cyclic synchronous torque (CST)."""


class Nmt(IntEnum):
    """States of a node in its heartbeat."""

    BOOT_UP = 0x00
    STOPPED = 0x04
    OPERATIONAL = 0x05
    PRE_OPERATIONAL = 0x7F


class NmtCommand(IntEnum):
    """First byte of a frame on id 0; the second is the node, 0 for all."""

    START = 0x01
    STOP = 0x02
    ENTER_PRE_OPERATIONAL = 0x80
    RESET_NODE = 0x81
    RESET_COMMUNICATION = 0x82


class Setpoint(NamedTuple):
    """RPDO1."""

    controlword: int
    mode: int
    position: int
    """increments"""


class FeedForward(NamedTuple):
    """RPDO2."""

    velocity: int
    """increments/s"""
    torque: int
    """thousandths of the rated torque"""


class Status(NamedTuple):
    """TPDO1."""

    statusword: int
    position: int
    torque: int


class Motion(NamedTuple):
    """TPDO2."""

    velocity: int
    mode: int


class Emergency(NamedTuple):
    """An EMCY object (CiA 301)."""

    code: int
    """0 where the cause has gone."""
    register: int
    """Error register, object 0x1001."""
    extra: bytes
    """5 bytes of the manufacturer's."""


SETPOINT = struct.Struct("<Hbi")
FEED_FORWARD = struct.Struct("<ih")
STATUS = struct.Struct("<Hih")
MOTION = struct.Struct("<ib")
EMERGENCY = struct.Struct("<HB5s")


def encode_setpoint(setpoint: Setpoint) -> bytes:
    """Return the 7 bytes of RPDO1. Raises struct.error for a value that does not fit."""
    return SETPOINT.pack(*setpoint)


def decode_setpoint(data: bytes) -> Setpoint:
    return Setpoint(*SETPOINT.unpack(data))


def encode_feed_forward(feed_forward: FeedForward) -> bytes:
    """Return the 6 bytes of RPDO2. Raises struct.error for a value that does not fit."""
    return FEED_FORWARD.pack(*feed_forward)


def decode_feed_forward(data: bytes) -> FeedForward:
    return FeedForward(*FEED_FORWARD.unpack(data))


def encode_status(status: Status) -> bytes:
    """Return the 8 bytes of TPDO1."""
    return STATUS.pack(*status)


def decode_status(data: bytes) -> Status:
    return Status(*STATUS.unpack(data))


def encode_motion(motion: Motion) -> bytes:
    """Return the 5 bytes of TPDO2."""
    return MOTION.pack(*motion)


def decode_motion(data: bytes) -> Motion:
    return Motion(*MOTION.unpack(data))


def encode_emergency(emergency: Emergency) -> bytes:
    """Return the 8 bytes of an EMCY frame."""
    return EMERGENCY.pack(*emergency)


def decode_emergency(data: bytes) -> Emergency:
    return Emergency(*EMERGENCY.unpack(data))


def encode_heartbeat(state: Nmt) -> bytes:
    """Return the byte of a heartbeat."""
    return bytes((state,))


def encode_nmt(command: NmtCommand, node: int) -> bytes:
    """Return the 2 bytes of a network management command."""
    return bytes((command, node))
