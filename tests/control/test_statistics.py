"""What a run's ticks add up to."""

import numpy as np
import pytest

from robotctl.control.shared import tick_dtype
from robotctl.control.statistics import Tail, TickStatistics, percentiles_us
from robotctl.safety.shaper import Clip

PERIOD = 2_000_000


def ticks(count, first=0):
    records = np.zeros(count, tick_dtype(7))
    records["tick"] = np.arange(first, first + count)
    records["stamp_ns"] = 10**15 + PERIOD * records["tick"]
    return records


def test_percentiles():
    assert percentiles_us(np.arange(1001) * 1000) == {"p50": 500.0, "p99": 990.0, "p999": 999.0, "max": 1000.0}
    assert percentiles_us(np.array([1500])) == {"p50": 1.5, "p99": 1.5, "p999": 1.5, "max": 1.5}
    assert percentiles_us(np.empty(0)) is None


def test_a_run_in_portions_is_the_same_as_in_one():
    records = ticks(5000)
    rng = np.random.default_rng(1)
    records["duration_ns"] = rng.integers(50_000, 500_000, 5000)
    records["lateness_ns"] = rng.integers(0, 3_000_000, 5000)
    records["clip"] = rng.choice([0, Clip.SPHERE, Clip.RECOVERY, Clip.POSITION | Clip.RECOVERY], 5000)
    whole, parts = TickStatistics(PERIOD), TickStatistics(PERIOD)
    whole.take(records)
    for portion in np.array_split(records, 37):
        parts.take(portion)
        parts.take(records[:0])
    assert whole.report() == parts.report()
    assert whole.clipped == parts.clipped == int(np.isin(records["clip"], [Clip.SPHERE, 2 | 16]).sum())
    assert whole.overruns == parts.overruns == int((records["lateness_ns"] > PERIOD).sum()) > 0


def test_the_rate_counts_intervals_not_records():
    statistics = TickStatistics(PERIOD)
    statistics.take(ticks(501))
    assert statistics.report()["servo_hz"] == 500.0
    assert statistics.report()["ticks"] == 501


def test_ticks_that_nobody_read_still_happened():
    statistics = TickStatistics(PERIOD)
    statistics.take(ticks(100))
    statistics.take(ticks(100, first=400), dropped=300)
    assert statistics.dropped == 300
    assert statistics.report()["ticks"] == 500
    assert statistics.report()["dropped"] == 300
    assert statistics.report()["servo_hz"] == 500.0


@pytest.mark.parametrize(("lateness", "late"), [(PERIOD, 0), (PERIOD + 1, 1)])
def test_an_overrun_is_more_than_a_period_late(lateness, late):
    records = ticks(3)
    records["lateness_ns"][1] = lateness
    statistics = TickStatistics(PERIOD)
    statistics.take(records)
    assert statistics.overruns == late


def test_the_buffer_may_be_reused_after_taking():
    records = ticks(10)
    records["duration_ns"] = 1000
    statistics = TickStatistics(PERIOD)
    statistics.take(records)
    records["duration_ns"] = 99_000
    assert statistics.report()["tick_us"]["max"] == 1.0


def test_nothing_taken():
    report = TickStatistics(PERIOD).report()
    assert report == {
        "ticks": 0,
        "servo_hz": 0.0,
        "overruns": 0,
        "dropped": 0,
        "tick_us": None,
        "lateness_us": None,
    }


def test_a_run_without_end_keeps_the_latest_values_and_no_more(monkeypatch):
    monkeypatch.setattr("robotctl.control.statistics.REMEMBERED", 1000)
    tail = Tail()
    for value in range(0, 100_000, 30):
        tail.take(np.arange(value, value + 30))
        assert sorted(tail.values) == list(range(max(0, value + 30 - 1000), value + 30))
    tail.take(np.arange(5000))
    assert sorted(tail.values) == list(range(4000, 5000))
    assert tail.report_us()["max"] == 100.0  # of all there ever were, 99,989 ns
