"""A trip: why the arm was stopped, as data."""

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


class Protection(IntEnum):
    """The protections that can stop an arm, numbered as in docs/safety.md."""

    POSITION = 3
    SPHERE = 5
    TORQUE_STATE = 8
    MALFORMED = 9
    HEARTBEAT = 10
    FEEDBACK = 12
    TRACKING = 17
    OPERATOR = 22
    ESTOP = 23
    DRIVE = 24
    RESET = 29

    @property
    def label(self) -> str:
        return f"P{self.value}"


class Trip(NamedTuple):
    """One trip of one protection."""

    protection: Protection
    category: Category
    cause: str
    """What happened, where, with numbers, and what to do about it."""
    onset_ns: int
    """When the condition became true; the reaction time counts from here."""
