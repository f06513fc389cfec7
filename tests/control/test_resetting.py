"""Resets: routines in order, each tried three times with growing pauses, then a trip that wants the operator."""

import numpy as np
import pytest

from robotctl.control.resetting import PAUSES_S, Resetting
from robotctl.hal.robot import Robot
from robotctl.hal.types import Sample
from robotctl.safety.routines import Routine
from robotctl.safety.trip import Category, Clearing, Protection, Trip

REST = np.zeros(7)
SAMPLE = Sample(0, REST, REST, REST, np.zeros(7, np.int64), enabled=True)
TICK = 2_000_000
START = 5_000_000_000


class Scripted(Routine):
    """Wants 1 rad/s on every joint until it is told to arrive."""

    def __init__(self, name: str, timeout_s: float = 2.0) -> None:
        self.name = name
        self.timeout_s = timeout_s
        self.arrived = False

    def velocity(self, sample, position):
        return None if self.arrived else np.ones(7)


def run(resetting: Resetting, seconds: float, start: int = START) -> tuple[list[object], int]:
    """Tick for some seconds, or until it ends; return the last answer of each tick, and the time."""
    answers: list[object] = []
    now = start
    while now < start + seconds * 1e9:
        answers.append(resetting.velocity(SAMPLE, REST, now))
        if answers[-1] is None or isinstance(answers[-1], Trip):
            break
        now += TICK
    return answers, now


def test_routines_run_one_after_the_other(panda: Robot) -> None:
    one, two = Scripted("one"), Scripted("two")
    resetting = Resetting(panda, [one, two], START)
    assert np.array_equal(resetting.velocity(SAMPLE, REST, START), np.ones(7))
    one.arrived = True
    assert np.array_equal(resetting.velocity(SAMPLE, REST, START + TICK), REST)
    assert np.array_equal(resetting.velocity(SAMPLE, REST, START + 2 * TICK), np.ones(7))
    two.arrived = True
    assert resetting.velocity(SAMPLE, REST, START + 3 * TICK) is None


def test_each_routine_has_its_own_time(panda: Robot) -> None:
    one, two = Scripted("one"), Scripted("two")
    resetting = Resetting(panda, [one, two], START)
    _, now = run(resetting, 1.9)
    one.arrived = True
    answers, _ = run(resetting, 1.9, now)
    assert np.array_equal(answers[-1], np.ones(7))


def test_a_routine_that_does_not_arrive_rests_longer_and_longer_and_is_given_up_after_three_tries(panda: Robot) -> None:
    resetting = Resetting(panda, [Scripted("stuck")], START)
    answers, now = run(resetting, 60.0)
    moving = np.array([bool(np.any(answer)) for answer in answers[:-1]])
    edges = np.flatnonzero(np.diff(moving.astype(int)) != 0) + 1
    lengths = np.diff([0, *edges, len(moving)]) * TICK * 1e-9
    tries, pauses = lengths[::2], lengths[1::2]
    assert tries == pytest.approx([2.0, 2.0, 2.0], abs=0.01)
    assert pauses == pytest.approx([panda.stopping_time_s + pause for pause in PAUSES_S], abs=0.01)
    assert pauses[0] < pauses[1]
    trip = answers[-1]
    assert isinstance(trip, Trip)
    assert (trip.protection, trip.category) == (Protection.RESET, Category.BRAKE_HOLD)
    assert trip.cause.startswith("reset routine 'stuck' did not arrive in 3 tries of 2 s")
    assert 0 < now - trip.onset_ns <= TICK
    assert trip.protection.clearing is Clearing.ACK


def test_a_second_try_that_arrives_is_a_success_and_the_next_routine_has_all_its_tries(panda: Robot) -> None:
    one, two = Scripted("one"), Scripted("two")
    resetting = Resetting(panda, [one, two], START)
    _, now = run(resetting, 2.0 + panda.stopping_time_s + PAUSES_S[0] + 0.1)
    one.arrived = True
    answers, end = run(resetting, 60.0, now)
    assert isinstance(answers[-1], Trip)
    assert "'two' did not arrive in 3 tries" in answers[-1].cause
    assert end - now > 3 * 2.0e9 + sum(PAUSES_S) * 1e9


def test_the_last_moment_still_counts(panda: Robot) -> None:
    routine = Scripted("slow")
    resetting = Resetting(panda, [routine], START)
    routine.arrived = True
    assert resetting.velocity(SAMPLE, REST, START + 2_000_000_000) is None
