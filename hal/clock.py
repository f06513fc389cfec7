"""One clock, handed in: monotonic nanoseconds, real or virtual."""

import time
from typing import Protocol


class Clock(Protocol):
    """Monotonic time in nanoseconds, and a way to wait for it."""

    def now_ns(self) -> int:
        """Return the present time in nanoseconds."""
        ...

    def sleep_until(self, deadline_ns: int) -> None:
        """Return no earlier than `deadline_ns`; at once if that has passed."""
        ...


class MonotonicClock:
    """The machine's CLOCK_MONOTONIC."""

    def now_ns(self) -> int:
        return time.monotonic_ns()

    def sleep_until(self, deadline_ns: int) -> None:
        remaining = deadline_ns - time.monotonic_ns()
        if remaining > 0:
            time.sleep(remaining * 1e-9)


class VirtualClock:
    """Time that moves only when somebody waits for it: lockstep simulation and tests."""

    def __init__(self, start_ns: int = 0) -> None:
        self._now_ns = start_ns

    def now_ns(self) -> int:
        return self._now_ns

    def sleep_until(self, deadline_ns: int) -> None:
        self._now_ns = max(self._now_ns, deadline_ns)
