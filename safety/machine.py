"""The supervisor's state machine: one literal table. A pair that is not listed is refused.

| state      | what may go out                                    |
|------------|----------------------------------------------------|
| OFF        | nothing is open                                    |
| SILENT     | nothing: receive only                              |
| READY      | register reads and feedback requests               |
| ARMED      | drives enabled, holding                            |
| RUN        | the policy's motion                                |
| RESET      | a reset routine's motion, at reduced caps          |
| STOPPING   | braking                                            |
| HOLD       | position hold after a stop                         |
| DISABLED   | the profile's category 0 action                    |
| FAULT      | nothing, until an operator acknowledges            |
"""

from enum import IntEnum


class State(IntEnum):
    """Where the supervisor is."""

    OFF = 0
    SILENT = 1
    READY = 2
    ARMED = 3
    RUN = 4
    RESET = 5
    STOPPING = 6
    HOLD = 7
    DISABLED = 8
    FAULT = 9


class Event(IntEnum):
    """What can happen to it."""

    CONNECT = 1
    SELFTEST = 2
    ARM = 3
    START = 4
    RESET = 5
    RESET_DONE = 6
    STOP = 7
    """Operator: brake and hold (category 2)."""
    DISARM = 8
    """Operator: brake, then drives off (category 1), without a fault."""
    TRIP_HOLD = 9
    """A protection asks for category 2."""
    TRIP_OFF = 10
    """A protection asks for category 1."""
    TRIP_CUT = 11
    """A protection asks for category 0."""
    STANDSTILL_HOLD = 12
    """At rest after a category 2 stop."""
    STANDSTILL_OFF = 13
    """At rest after a category 1 stop, drives to go off."""
    OFF_CLEAN = 14
    """Drives confirmed off after DISARM."""
    OFF_FAULT = 15
    """Drives off after a trip."""
    CLEARED = 16
    """The cause of an automatic stop went away in time."""
    ACK = 17
    """Operator: acknowledge."""
    CLOSE = 18


S, E = State, Event

_MOVING = (S.ARMED, S.RUN, S.RESET, S.STOPPING, S.HOLD)

TRANSITIONS: dict[tuple[State, Event], State] = {
    (S.OFF, E.CONNECT): S.SILENT,
    (S.SILENT, E.SELFTEST): S.READY,
    (S.READY, E.ARM): S.ARMED,
    (S.ARMED, E.START): S.RUN,
    (S.ARMED, E.RESET): S.RESET,
    (S.RESET, E.RESET_DONE): S.ARMED,
    # Going down is always allowed.
    (S.ARMED, E.STOP): S.STOPPING,
    (S.RUN, E.STOP): S.STOPPING,
    (S.RESET, E.STOP): S.STOPPING,
    (S.STOPPING, E.STOP): S.STOPPING,
    (S.HOLD, E.STOP): S.HOLD,
    **{(state, E.DISARM): S.STOPPING for state in _MOVING},
    # A trip stops from every state with enabled drives; a stop may become harder, never softer.
    **{(state, E.TRIP_HOLD): S.STOPPING for state in (S.ARMED, S.RUN, S.RESET)},
    **{(state, E.TRIP_OFF): S.STOPPING for state in _MOVING},
    **{(state, E.TRIP_CUT): S.DISABLED for state in _MOVING},
    (S.STOPPING, E.STANDSTILL_HOLD): S.HOLD,
    (S.STOPPING, E.STANDSTILL_OFF): S.DISABLED,
    (S.DISABLED, E.OFF_CLEAN): S.READY,
    (S.DISABLED, E.OFF_FAULT): S.FAULT,
    (S.READY, E.TRIP_OFF): S.FAULT,
    (S.READY, E.TRIP_CUT): S.FAULT,
    # A stop that clears by itself goes back to the policy; a latched one waits for a person.
    (S.STOPPING, E.CLEARED): S.RUN,
    (S.HOLD, E.CLEARED): S.RUN,
    (S.HOLD, E.ACK): S.ARMED,
    (S.HOLD, E.START): S.RUN,  # where the cause of the stop takes START as acknowledgement
    # After a fault the self-test runs again.
    (S.FAULT, E.ACK): S.SILENT,
    (S.SILENT, E.CLOSE): S.OFF,
    (S.READY, E.CLOSE): S.OFF,
    (S.FAULT, E.CLOSE): S.OFF,
}

ENABLED = frozenset(_MOVING)
"""States in which the drives are on."""


class Refused(Exception):  # noqa: N818 - an answer more than an error
    """An event that its state does not allow."""

    def __init__(self, state: State, event: Event, why: str = "") -> None:
        super().__init__(f"{event.name} is refused in state {state.name}{': ' if why else ''}{why}")
        self.state = state
        self.event = event


def after(state: State, event: Event) -> State:
    """Return the state that `event` leads to.

    Raises:
        Refused: if the pair is not in the table.
    """
    try:
        return TRANSITIONS[state, event]
    except KeyError:
        raise Refused(state, event) from None
