"""When the control process ticks, on a clock that sleeps too long to order."""

import os
from collections.abc import Iterable
from types import SimpleNamespace

import pytest

from robotctl.control.process import _pace
from robotctl.hal.clock import VirtualClock
from robotctl.safety.machine import State

PERIOD = 2_000_000


class SleepyClock(VirtualClock):
    """Wakes late by what it was told to, once per sleep."""

    def __init__(self, late: Iterable[int]) -> None:
        super().__init__()
        self._late = iter(late)

    def sleep_until(self, deadline_ns: int) -> None:
        super().sleep_until(deadline_ns)
        self._now_ns += next(self._late)


class PacedLoop:
    """Notes when its ticks begin and what it is told, and lets each take its time."""

    def __init__(self, clock: VirtualClock, durations: Iterable[int]) -> None:
        self.robot = SimpleNamespace(period_ns=PERIOD)
        self.supervisor = SimpleNamespace(state=State.RUN)
        self.closed = False
        self.lateness_ns = self.skipped = 0
        self.ticks: list[tuple[int, int, int]] = []
        self._clock = clock
        self._durations = list(durations)

    def tick(self) -> None:
        self.ticks.append((self._clock.now_ns(), self.lateness_ns, self.skipped))
        self._clock._now_ns += self._durations.pop(0)
        self.closed = not self._durations


def paced(late: list[int], durations: list[int] | None = None) -> list[tuple[int, int, int]]:
    clock = SleepyClock(late)
    loop = PacedLoop(clock, durations or [0] * len(late))
    _pace(loop, clock, os.getppid())  # type: ignore[arg-type]
    return loop.ticks


def test_on_time_there_is_one_tick_per_period() -> None:
    assert paced([0, 0, 0]) == [(PERIOD * n, 0, 0) for n in (1, 2, 3)]


def test_what_was_slept_through_is_known_before_the_tick_and_the_next_comes_at_its_own_time() -> None:
    ticks = paced([0, 5_000_000, 0, 0])
    assert ticks == [
        (2_000_000, 0, 0),
        (9_000_000, 5_000_000, 2),  # due at 4 ms
        (10_000_000, 0, 0),
        (12_000_000, 0, 0),
    ]


def test_a_tick_that_takes_long_makes_the_next_one_late() -> None:
    assert paced([0, 0, 0], durations=[7_000_000, 0, 0]) == [
        (2_000_000, 0, 0),
        (9_000_000, 5_000_000, 2),
        (10_000_000, 0, 0),
    ]


@pytest.mark.parametrize("late", [[0] * 9, [1_999_999] * 9, [2_000_000] * 9, [0, 300_000_000, 0], [7, 3_100_000, 0, 9]])
def test_the_reference_makes_as_many_steps_as_periods_have_passed(late: list[int]) -> None:
    steps = 0
    for now, _, skipped in paced(late):
        steps += 1 + skipped
        assert steps == now // PERIOD
