"""Every state and every event: listed pairs lead where the table says, all others are refused."""

import itertools

import pytest

from robotctl.safety.machine import ENABLED, TRANSITIONS, Event, Refused, State, after

PAIRS = list(itertools.product(State, Event))


@pytest.mark.parametrize(("state", "event"), PAIRS, ids=[f"{s.name}-{e.name}" for s, e in PAIRS])
def test_every_pair(state: State, event: Event) -> None:
    if (state, event) in TRANSITIONS:
        assert after(state, event) is TRANSITIONS[state, event]
    else:
        with pytest.raises(Refused, match=f"{event.name} is refused in state {state.name}"):
            after(state, event)


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
