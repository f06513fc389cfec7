"""Silence, as it is counted by somebody who sleeps as well."""

from robotctl.control.pulse import Pulse

MS = 1_000_000


def test_a_sign_that_changes_is_no_silence() -> None:
    pulse = Pulse()
    assert [pulse.silence_ns(sign, 5 * MS * sign) for sign in range(10)] == [0] * 10


def test_silence_counts_from_the_first_look_at_a_sign() -> None:
    pulse = Pulse()
    assert [pulse.silence_ns("same", 10**15 + at * MS) for at in (0, 5, 10, 30)] == [0, 5 * MS, 10 * MS, 30 * MS]
    assert pulse.silence_ns("other", 10**15 + 31 * MS) == 0
    assert pulse.silence_ns("other", 10**15 + 33 * MS) == 2 * MS


def test_who_slept_long_does_not_blame_the_other_for_it() -> None:
    pulse = Pulse()
    assert [pulse.silence_ns(1, at * MS) for at in (0, 1000, 1005, 1026)] == [0, 20 * MS, 25 * MS, 45 * MS]
