"""The pure state machine: every statusword there is, against every goal."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from robotctl.hal.can.cia402.machine import Goal, State, Word, controlword, state_of

statuswords = st.integers(0, 0xFFFF)
goals = st.sampled_from(Goal)


@pytest.mark.parametrize(
    ("statusword", "state"),
    [
        (0x0000, State.NOT_READY),
        (0x0250, State.OFF),
        (0x0231, State.READY),
        (0x0233, State.SWITCHED_ON),
        (0x1637, State.ENABLED),
        (0x0217, State.QUICK_STOP),
        (0x021F, State.FAULT_REACTION),
        (0x0218, State.FAULT),
        (0x0238, State.FAULT),  # bit 5 means nothing in a fault
        (0x0234, None),
    ],
)
def test_states_are_told_by_their_bits(statusword: int, state: State | None):
    assert state_of(statusword) is state


def test_every_statusword_is_of_one_state_or_none():
    """By the standard's masks, written down once more."""
    masks = {
        State.NOT_READY: (0x4F, 0x00), State.OFF: (0x4F, 0x40), State.READY: (0x6F, 0x21),
        State.SWITCHED_ON: (0x6F, 0x23), State.ENABLED: (0x6F, 0x27), State.QUICK_STOP: (0x6F, 0x07),
        State.FAULT_REACTION: (0x4F, 0x0F), State.FAULT: (0x4F, 0x08),
    }  # fmt: skip
    for statusword in range(0x10000):
        found = [state for state, (mask, value) in masks.items() if statusword & mask == value]
        assert found == ([state_of(statusword)] if state_of(statusword) else [])


@given(statuswords)
def test_the_way_to_torque_goes_state_by_state(statusword: int):
    wanted = {
        State.OFF: Word.SHUTDOWN,
        State.READY: Word.SWITCH_ON,
        State.SWITCHED_ON: Word.ENABLE_OPERATION,
        State.ENABLED: Word.ENABLE_OPERATION,
    }
    assert controlword(statusword, Goal.ON) == wanted.get(state_of(statusword), Word.DISABLE_VOLTAGE)


@given(statuswords)
def test_off_is_off(statusword: int):
    assert controlword(statusword, Goal.OFF) == 0


@given(statuswords)
def test_a_drive_that_went_off_by_itself_is_not_led_back(statusword: int):
    enabled = state_of(statusword) is State.ENABLED
    assert controlword(statusword, Goal.STAY) == (Word.ENABLE_OPERATION if enabled else 0)


@given(statuswords, goals)
def test_only_clearing_clears_and_only_in_a_fault(statusword: int, goal: Goal):
    resets = bool(controlword(statusword, goal) & 0x80)
    assert resets == (goal is Goal.CLEAR and state_of(statusword) is State.FAULT)


@given(statuswords)
def test_clearing_never_enables(statusword: int):
    assert not controlword(statusword, Goal.CLEAR) & 0x0F


@given(statuswords, goals)
def test_nothing_leads_on_from_a_fault_or_a_quick_stop(statusword: int, goal: Goal):
    if state_of(statusword) in (State.FAULT, State.FAULT_REACTION, State.QUICK_STOP, State.NOT_READY, None):
        assert not controlword(statusword, goal) & 0x0F


@given(goals)
def test_a_drive_with_every_wish_granted_ends_where_it_is_wanted(goal: Goal):
    """A drive of four lines, that does what each word says."""
    bits = {State.OFF: 0x40, State.READY: 0x21, State.SWITCHED_ON: 0x23, State.ENABLED: 0x27, State.FAULT: 0x08}
    after = {Word.SHUTDOWN: State.READY, Word.SWITCH_ON: State.SWITCHED_ON, Word.ENABLE_OPERATION: State.ENABLED}
    for start in bits:
        state = start
        for _ in range(5):
            word = controlword(bits[state], goal)
            if state is State.FAULT:
                state = State.OFF if word is Word.FAULT_RESET else State.FAULT
            else:
                state = after.get(word, State.OFF)
        if goal is Goal.ON:
            assert state is (State.FAULT if start is State.FAULT else State.ENABLED)
        elif goal is Goal.CLEAR:
            assert state is State.OFF
        elif goal is Goal.STAY:
            assert state is {State.FAULT: State.FAULT, State.ENABLED: State.ENABLED}.get(start, State.OFF)
        else:
            assert state is (State.FAULT if start is State.FAULT else State.OFF)
