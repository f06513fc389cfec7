"""Every state and every event: listed pairs lead where the table says, all others are refused."""

import itertools

import pytest

from robotctl.safety.machine import ENABLED, TRANSITIONS, Event, Refused, State, after

PAIRS = list(itertools.product(State, Event))
GOING_DOWN = {
    Event.STOP: State.STOPPING,
    Event.DISARM: State.STOPPING,
    Event.TRIP_HOLD: State.STOPPING,
    Event.TRIP_OFF: State.STOPPING,
    Event.TRIP_CUT: State.DISABLED,
}
LEFT_BY: dict[State, dict[Event, State]] = {
    State.OFF: {Event.CONNECT: State.SILENT},
    State.SILENT: {Event.SELFTEST: State.READY, Event.CLOSE: State.OFF},
    State.READY: {
        Event.ARM: State.ARMED,
        Event.TRIP_OFF: State.FAULT,
        Event.TRIP_CUT: State.FAULT,
        Event.CLOSE: State.OFF,
    },
    State.ARMED: {Event.START: State.RUN, Event.RESET: State.RESET, **GOING_DOWN},
    State.RUN: GOING_DOWN,
    State.RESET: {Event.RESET_DONE: State.ARMED, **GOING_DOWN},
    State.STOPPING: {
        Event.STANDSTILL_HOLD: State.HOLD,
        Event.STANDSTILL_OFF: State.DISABLED,
        Event.CLEARED: State.RUN,
        **{event: to for event, to in GOING_DOWN.items() if event is not Event.TRIP_HOLD},
    },
    State.HOLD: {
        Event.ACK: State.ARMED,
        Event.START: State.RUN,
        Event.CLEARED: State.RUN,
        Event.STOP: State.HOLD,
        Event.DISARM: State.STOPPING,
        Event.TRIP_OFF: State.STOPPING,
        Event.TRIP_CUT: State.DISABLED,
    },
    State.DISABLED: {Event.OFF_CLEAN: State.READY, Event.OFF_FAULT: State.FAULT},
    State.FAULT: {Event.ACK: State.SILENT, Event.CLOSE: State.OFF},
}
"""The table again, by state."""


@pytest.mark.parametrize(("state", "event"), PAIRS, ids=[f"{s.name}-{e.name}" for s, e in PAIRS])
def test_every_pair(state: State, event: Event) -> None:
    if event in LEFT_BY[state]:
        assert after(state, event) is LEFT_BY[state][event]
    else:
        with pytest.raises(Refused, match=f"{event.name} is refused in state {state.name}$") as refused:
            after(state, event)
        assert (refused.value.state, refused.value.event) == (state, event)


def test_a_refusal_may_say_why() -> None:
    assert str(Refused(State.HOLD, Event.START, "not yet")) == "START is refused in state HOLD: not yet"


def test_only_arming_enables_and_only_from_ready() -> None:
    entries = [(s, e) for (s, e), to in TRANSITIONS.items() if to in ENABLED and s not in ENABLED]
    assert entries == [(State.READY, Event.ARM)]


def test_motion_takes_two_deliberate_steps_after_any_stop() -> None:
    for (state, event), to in TRANSITIONS.items():
        if to in (State.RUN, State.RESET):
            # From HOLD, START is both acknowledgement and start, where the cause of the stop allows that.
            assert state is State.ARMED or event is Event.CLEARED or (state, event) == (State.HOLD, Event.START)


def test_a_fault_is_left_only_by_an_operator() -> None:
    assert {event for state, event in TRANSITIONS if state is State.FAULT} == {Event.ACK, Event.CLOSE}
    assert after(State.FAULT, Event.ACK) is State.SILENT


def test_every_enabled_state_stops_on_a_trip() -> None:
    for state in ENABLED:
        assert after(state, Event.TRIP_OFF) is State.STOPPING
        assert after(state, Event.TRIP_CUT) is State.DISABLED
        assert after(state, Event.DISARM) is State.STOPPING


def test_every_state_is_reachable() -> None:
    reached, frontier = {State.OFF}, [State.OFF]
    while frontier:
        here = frontier.pop()
        for (state, _), to in TRANSITIONS.items():
            if state is here and to not in reached:
                reached.add(to)
                frontier.append(to)
    assert reached == set(State)
