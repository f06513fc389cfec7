"""P11: what a late loop is allowed, to the nanosecond."""

import pytest

from robotctl.hal.robot import Robot
from robotctl.safety.overrun import Overrun
from robotctl.safety.trip import Category, Protection, Trip

BEGIN = 7_000_000_000
GAP = 20_000_000
TICKS = 5


class Ticks:
    """Begins ticks one after the other, by default on time."""

    def __init__(self, robot: Robot) -> None:
        self.overrun = Overrun(robot)
        self.period = robot.period_ns
        self.now = BEGIN
        self.check()

    def check(self, late: int = 0) -> Trip | None:
        return self.overrun.check(late, self.now)

    def tick(self, late: int = 0, gap: int | None = None) -> Trip | None:
        self.now += self.period if gap is None else gap
        return self.check(late)


@pytest.fixture
def ticks(panda: Robot) -> Ticks:
    safety = panda.profile.safety
    assert (safety.overrun_ticks, safety.overrun_s) == (TICKS, GAP * 1e-9)
    return Ticks(panda)


def test_a_loop_on_time_never_trips(ticks: Ticks) -> None:
    assert not any(ticks.tick() for _ in range(10_000))


def test_late_by_a_period_is_on_time_for_ever(ticks: Ticks) -> None:
    assert not any(ticks.tick(late=ticks.period) for _ in range(100))


def test_five_late_ticks_in_a_row_brake_and_hold(ticks: Ticks) -> None:
    late = ticks.period + 1
    assert not any(ticks.tick(late) for _ in range(TICKS - 1))
    trip = ticks.tick(late)
    assert trip is not None
    assert (trip.protection, trip.category) == (Protection.OVERRUN, Category.BRAKE_HOLD)
    assert trip.onset_ns == ticks.now
    assert trip.cause == "5 ticks in a row came more than 2 ms late; find what holds the loop up, then acknowledge"
    trip = ticks.tick(late)
    assert trip is not None
    assert trip.cause.startswith("6 ticks")


def test_one_tick_on_time_begins_the_count_anew(ticks: Ticks) -> None:
    late = ticks.period + 1
    for _ in range(3):
        assert not any(ticks.tick(late) for _ in range(TICKS - 1))
        assert ticks.tick() is None


def test_the_longest_gap_allowed_is_20_ms_beyond_the_period(ticks: Ticks) -> None:
    assert ticks.tick(gap=ticks.period + GAP) is None
    trip = ticks.tick(gap=ticks.period + GAP + 1)
    assert trip is not None
    assert (trip.protection, trip.category) == (Protection.OVERRUN, Category.BRAKE_OFF)
    assert trip.onset_ns == ticks.now - 1
    assert trip.cause.startswith("the loop stood still for 22.0 ms, 22 ms are allowed; find what held it up")
    assert ticks.tick() is None


def test_a_clock_that_jumps_ahead_is_a_gap(ticks: Ticks) -> None:
    trip = ticks.tick(gap=10**15)
    assert trip is not None
    assert trip.category is Category.BRAKE_OFF
    assert trip.onset_ns == ticks.now - 10**15 + ticks.period + GAP


def test_a_clock_that_goes_back_is_a_gap(ticks: Ticks) -> None:
    assert ticks.tick(gap=0) is None
    trip = ticks.tick(gap=-1)
    assert trip is not None
    assert trip.category is Category.BRAKE_OFF
    assert trip.onset_ns == ticks.now


def test_the_gap_is_the_harder_of_the_two(ticks: Ticks) -> None:
    for _ in range(TICKS - 1):
        ticks.tick(ticks.period + 1)
    trip = ticks.tick(ticks.period + 1, gap=10**9)
    assert trip is not None
    assert trip.category is Category.BRAKE_OFF


def test_what_takes_its_time_by_design_counts_neither_as_late_nor_as_a_gap(ticks: Ticks) -> None:
    late = ticks.period + 1
    for _ in range(TICKS - 1):
        ticks.tick(late)
    ticks.overrun.restart()
    assert not any(ticks.tick(late, gap) for gap in (10**9, None, None, None))
    assert ticks.tick(late) is not None


def test_the_first_late_ticks_count_like_any_other(panda: Robot) -> None:
    overrun, period = Overrun(panda), panda.period_ns
    trips = [overrun.check(period + 1, BEGIN + number * period) for number in range(TICKS)]
    assert [trip is not None for trip in trips] == [False] * (TICKS - 1) + [True]
