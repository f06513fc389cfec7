"""P11: the loop comes late: once by far, or a little again and again."""

from robotctl.hal.robot import Robot
from robotctl.safety.trip import Category, Protection, Trip


class Overrun:
    """Watches when ticks begin. Asked in every tick, whatever the state: a gap shows only against the tick before."""

    def __init__(self, robot: Robot) -> None:
        safety = robot.profile.safety
        self._period_ns = robot.period_ns
        self._longest_ns = robot.period_ns + round(safety.overrun_s * 1e9)
        self._most = safety.overrun_ticks
        self.restart()

    def restart(self) -> None:
        """Begin anew after something that takes its time by design, such as enabling the drives."""
        self._row = 0
        self._last_ns: int | None = None

    def check(self, lateness_ns: int, now_ns: int) -> Trip | None:
        """Judge the tick that begins at `now_ns`, `lateness_ns` after it was due.

        A clock that jumps, back or ahead, is a gap like any other: nothing that counts time can be believed.
        """
        last, self._last_ns = self._last_ns, now_ns
        self._row = self._row + 1 if lateness_ns > self._period_ns else 0
        gap = self._period_ns if last is None else now_ns - last
        if not 0 <= gap <= self._longest_ns:
            cause = (
                f"the loop stood still for {gap / 1e6:.1f} ms, {self._longest_ns / 1e6:g} ms are allowed; "
                "find what held it up, then acknowledge"
            )
            return Trip(Protection.OVERRUN, Category.BRAKE_OFF, cause, min(now_ns, now_ns - gap + self._longest_ns))
        if self._row >= self._most:
            cause = (
                f"{self._row} ticks in a row came more than {self._period_ns / 1e6:g} ms late; "
                "find what holds the loop up, then acknowledge"
            )
            return Trip(Protection.OVERRUN, Category.BRAKE_HOLD, cause, now_ns)
        return None
