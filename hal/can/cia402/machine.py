"""The state machine of a CiA 402 drive as seen from its two words. Pure: (statusword, goal) -> controlword.

What clears a fault and what leads to torque are different goals, and no word serves both: clearing ends in
SWITCH_ON_DISABLED, and from a fault nothing leads on. Source: IEC 61800-7-201, figures and tables of 0x6040, 0x6041.
"""

from enum import IntEnum, StrEnum


class State(StrEnum):
    """States of the drive, by their names in the standard."""

    NOT_READY = "NOT READY TO SWITCH ON"
    OFF = "SWITCH ON DISABLED"
    READY = "READY TO SWITCH ON"
    SWITCHED_ON = "SWITCHED ON"
    ENABLED = "OPERATION ENABLED"
    QUICK_STOP = "QUICK STOP ACTIVE"
    FAULT_REACTION = "FAULT REACTION ACTIVE"
    FAULT = "FAULT"


class Word(IntEnum):
    """Controlwords, object 0x6040."""

    DISABLE_VOLTAGE = 0x00
    QUICK_STOP = 0x02
    SHUTDOWN = 0x06
    SWITCH_ON = 0x07
    ENABLE_OPERATION = 0x0F
    FAULT_RESET = 0x80
    """Acts on the rising edge of its bit."""


class Goal(StrEnum):
    """What the host wants of a drive."""

    OFF = "off"
    """No torque, whatever the state."""
    ON = "on"
    """Torque, one state at a time. Not from a fault, and not out of a quick stop."""
    STAY = "stay"
    """As it is if it has torque; a drive that went off by itself is not led back."""
    CLEAR = "clear"
    """Out of a fault, to no torque."""


_PATH = {
    State.OFF: Word.SHUTDOWN,
    State.READY: Word.SWITCH_ON,
    State.SWITCHED_ON: Word.ENABLE_OPERATION,
    State.ENABLED: Word.ENABLE_OPERATION,
}
_STATES = {
    (0x4F, 0x00): State.NOT_READY,
    (0x4F, 0x40): State.OFF,
    (0x6F, 0x21): State.READY,
    (0x6F, 0x23): State.SWITCHED_ON,
    (0x6F, 0x27): State.ENABLED,
    (0x6F, 0x07): State.QUICK_STOP,
    (0x4F, 0x0F): State.FAULT_REACTION,
    (0x4F, 0x08): State.FAULT,
}
STATE_BITS = 0x6F
_BY_BITS = {bits: state for bits in range(0x70) for (mask, value), state in _STATES.items() if bits & mask == value}


def state_of(statusword: int) -> State | None:
    """Return the state that a statusword (0x6041) tells, or None for bits that the standard does not know."""
    return _BY_BITS.get(statusword & STATE_BITS)


def controlword(statusword: int, goal: Goal) -> Word:
    """Return the next word on the way from what a drive says it is to what is wanted of it."""
    state = state_of(statusword)
    if goal is Goal.ON and state is not None:
        return _PATH.get(state, Word.DISABLE_VOLTAGE)
    if goal is Goal.STAY and state is State.ENABLED:
        return Word.ENABLE_OPERATION
    if goal is Goal.CLEAR and state is State.FAULT:
        return Word.FAULT_RESET
    return Word.DISABLE_VOLTAGE
