"""What a CAN controller tells of trouble on the wire: SocketCAN's error frames, counted by kind.

Classes and fields are those of linux/can/error.h: the class stands in the id, details in the data. Only controllers
tell; a serial adapter has no such frames, and a virtual interface none but those that somebody sends on purpose.
"""

from collections import Counter
from enum import StrEnum
from typing import NamedTuple

ERROR_CONTROLLER = 0x004
ERROR_PROTOCOL = 0x008
ERROR_ACK = 0x020
ERROR_BUS_OFF = 0x040
ERROR_BUS = 0x080
ERROR_RESTARTED = 0x100
ERROR_COUNTERS = 0x200
_CONTROLLER_PASSIVE = 0x30
_CONTROLLER_ACTIVE = 0x40
PASSIVE_DATA = bytes([0, _CONTROLLER_PASSIVE, 0, 0, 0, 0, 0, 0])
RECOVERED_DATA = bytes([0, _CONTROLLER_ACTIVE, 0, 0, 0, 0, 0, 0])
"""Data of ERROR_CONTROLLER frames: too many errors, and few enough again."""
_LOCATION_ACK = 0x19
"""data[3] of a protocol error: it happened in the acknowledge slot."""


class ErrorKind(StrEnum):
    """What went wrong, as far as a cause can be told from it."""

    NO_ACK = "no acknowledgement"
    """Nobody else is on the bus with power: the host is alone."""
    GARBLED = "bus error"
    """Bits, stuffing, form or CRC: somebody is there, and is not understood."""
    CONTROLLER = "controller"
    """Warning, passive or overflow."""
    BUS_OFF = "bus-off"


class ErrorFrame(NamedTuple):
    """One error frame."""

    error_class: int
    data: bytes = bytes(8)


UNACKNOWLEDGED = ErrorFrame(ERROR_ACK)
GARBLED = ErrorFrame(ERROR_PROTOCOL | ERROR_BUS)


class ErrorLog:
    """The error frames of one channel."""

    def __init__(self) -> None:
        self.state = "active"
        """What they say of the controller: active, passive or bus-off."""
        self.kinds: Counter[ErrorKind] = Counter()
        self.counters: tuple[int, int] | None = None
        """The controller's transmit and receive error counters, where it tells."""

    def take(self, error_class: int, data: bytes | bytearray) -> None:
        """Count one frame."""
        kind = _kind(error_class, data)
        if kind is not None:
            self.kinds[kind] += 1
        if error_class & ERROR_COUNTERS and len(data) == 8:
            self.counters = data[6], data[7]
        if error_class & ERROR_BUS_OFF:
            self.state = "bus-off"
        elif error_class & ERROR_RESTARTED:
            self.state = "active"
        elif error_class & ERROR_CONTROLLER and len(data) > 1 and self.state != "bus-off":
            if data[1] & _CONTROLLER_PASSIVE:
                self.state = "passive"
            elif data[1] & _CONTROLLER_ACTIVE:
                self.state = "active"


def _kind(error_class: int, data: bytes | bytearray) -> ErrorKind | None:
    if error_class & ERROR_BUS_OFF:
        return ErrorKind.BUS_OFF
    if error_class & ERROR_ACK or (error_class & ERROR_PROTOCOL and len(data) > 3 and data[3] == _LOCATION_ACK):
        return ErrorKind.NO_ACK
    if error_class & (ERROR_PROTOCOL | ERROR_BUS):
        return ErrorKind.GARBLED
    return ErrorKind.CONTROLLER if error_class & ERROR_CONTROLLER else None
