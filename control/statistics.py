"""What a run's ticks add up to: rates, overruns, percentiles, clipped ticks."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from robotctl.safety.shaper import Clip

REMEMBERED = 300_000
"""Ticks whose durations and lateness are kept for percentiles: ten minutes at 500 Hz."""


def percentiles_us(nanoseconds: NDArray[Any]) -> dict[str, float] | None:
    """Return p50, p99, p999 and max in microseconds; None without data."""
    if not len(nanoseconds):
        return None
    p50, p99, p999 = (float(value) / 1e3 for value in np.percentile(nanoseconds, (50, 99, 99.9)))
    return {
        "p50": round(p50, 1),
        "p99": round(p99, 1),
        "p999": round(p999, 1),
        "max": round(nanoseconds.max() / 1e3, 1),
    }


class Tail:
    """The latest `REMEMBERED` values of a series that has no end, in no order."""

    def __init__(self) -> None:
        self._ring = np.zeros(REMEMBERED, dtype=np.int64)
        self._count = 0
        self._largest = 0

    def take(self, values: NDArray[Any]) -> None:
        """Add at least one value, in place of the oldest."""
        self._largest = max(self._largest, int(values.max()))
        kept = values[-REMEMBERED:]
        self._ring[np.arange(self._count, self._count + len(kept)) % REMEMBERED] = kept
        self._count += len(kept)

    @property
    def values(self) -> NDArray[Any]:
        """What is remembered; fewer as long as there were fewer."""
        return self._ring[: self._count]

    def report_us(self) -> dict[str, float] | None:
        """Return percentiles of what is remembered and the largest of all values ever, us; None without data."""
        percentiles = percentiles_us(self.values)
        return percentiles and {**percentiles, "max": round(self._largest / 1e3, 1)}


class TickStatistics:
    """Takes tick records in any portions. Percentiles are of the latest `REMEMBERED`, counts and maxima of all."""

    def __init__(self, period_ns: int) -> None:
        self._period_ns = period_ns
        self._durations = Tail()
        self._lateness = Tail()
        self.ticks = 0
        self.clipped = 0
        self.overruns = 0
        self.dropped = 0
        """Records that were overwritten before this side read them."""
        self._first_ns: int | None = None
        self._last_ns = 0

    def take(self, records: NDArray[Any], dropped: int = 0) -> None:
        self.dropped += dropped
        self.ticks += dropped
        if not len(records):
            return
        self._durations.take(records["duration_ns"])
        self._lateness.take(records["lateness_ns"])
        self.ticks += len(records)
        self.clipped += int((records["clip"] & ~Clip.RECOVERY != 0).sum())
        self.overruns += int((records["lateness_ns"] > self._period_ns).sum())
        if self._first_ns is None:
            self._first_ns = int(records["stamp_ns"][0])
        self._last_ns = int(records["stamp_ns"][-1])

    def report(self) -> dict[str, object]:
        """Return the numbers of the report's `timing` section."""
        elapsed = self._last_ns - (self._first_ns or 0)
        return {
            "ticks": self.ticks,
            "servo_hz": round((self.ticks - 1) / elapsed * 1e9, 2) if elapsed > 0 else 0.0,
            "overruns": self.overruns,
            "dropped": self.dropped,
            "tick_us": self._durations.report_us(),
            "lateness_us": self._lateness.report_us(),
        }
