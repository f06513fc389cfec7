"""A trip: why the arm was stopped, as data; and the list of protections, with what clears each."""

from enum import IntEnum
from typing import NamedTuple


class Category(IntEnum):
    """Stop categories after IEC 60204-1. A smaller number is the harder stop."""

    CUT = 0
    """Power removed at once, or what the profile does instead."""
    BRAKE_OFF = 1
    """Brake under control, then drives off."""
    BRAKE_HOLD = 2
    """Brake under control, then hold."""


class Clearing(IntEnum):
    """What it takes to go on after a latched stop."""

    START = 1
    """The operator's START is enough: it counts as acknowledgement."""
    ACK = 2
    """The operator acknowledges first."""
    POWER = 3
    """The drives' power has to be cycled before an acknowledgement is taken."""


class Protection(IntEnum):
    """The protections, numbered as in docs/safety.md."""

    VELOCITY = 1
    SOFT_LIMIT = 2
    POSITION = 3
    SPHERE = 5
    ACCELERATION = 6
    TORQUE = 7
    TORQUE_STATE = 8
    MALFORMED = 9
    HEARTBEAT = 10
    OVERRUN = 11
    FEEDBACK = 12
    BUS = 14
    RECEIVE = 15
    FRAMES = 16
    TRACKING = 17
    OVERSPEED = 18
    CONTACT = 19
    PROXIMITY = 20
    BUMP = 21
    DEADMAN = 22
    ESTOP = 23
    DRIVE = 24
    WEIGHTS = 26
    WATCHMAN = 27
    RESET = 29
    OPERATOR = 30

    @property
    def label(self) -> str:
        return f"P{self.value}"

    @property
    def clearing(self) -> Clearing:
        return _CLEARING.get(self, Clearing.ACK)


_CLEARING = {
    Protection.MALFORMED: Clearing.START,
    Protection.HEARTBEAT: Clearing.START,
    # A guard that tripped has met a bug, and a drive that failed keeps what it knows to itself.
    Protection.VELOCITY: Clearing.POWER,
    Protection.SOFT_LIMIT: Clearing.POWER,
    Protection.ACCELERATION: Clearing.POWER,
    Protection.TORQUE: Clearing.POWER,
    Protection.FRAMES: Clearing.POWER,
    Protection.DRIVE: Clearing.POWER,
}


class Trip(NamedTuple):
    """One trip of one protection."""

    protection: Protection
    category: Category
    cause: str
    """What happened, where, with numbers, and what to do about it."""
    onset_ns: int
    """When the condition became true; the reaction time counts from here."""
