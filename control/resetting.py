"""R5: reset routines one after the other, each tried again if it does not arrive; then the operator is needed (P29)."""

from collections.abc import Sequence

import numpy as np

from robotctl.hal.robot import Robot
from robotctl.hal.types import Sample, Vector
from robotctl.safety.routines import Routine
from robotctl.safety.trip import Category, Protection, Trip

PAUSES_S = (1.0, 3.0)
"""Rest before the second try and before the third, after the arm has braked. What trips meanwhile ends the reset."""


class Resetting:
    """One reset: at least one routine. Asked in every tick; it never blocks."""

    def __init__(self, robot: Robot, routines: Sequence[Routine], now_ns: int) -> None:
        self._robot = robot
        self._left = list(routines)
        self._rest = np.zeros(robot.dof)
        self._begin(now_ns)

    def velocity(self, sample: Sample, position: Vector, now_ns: int) -> Vector | Trip | None:
        """Return the wanted joint velocity (n,), rad/s, at reference `position`; None when done, a trip to give up."""
        if now_ns < self._begins_ns:
            return self._rest
        routine = self._left[0]
        ends_ns = self._begins_ns + round(routine.timeout_s * 1e9)
        if now_ns > ends_ns:
            return self._try_again(routine, ends_ns)
        velocity = routine.velocity(sample, position)
        if velocity is not None:
            return velocity
        self._left.pop(0)
        if not self._left:
            return None
        self._begin(now_ns)
        return self._rest

    def _begin(self, now_ns: int) -> None:
        self._failures = 0
        self._begins_ns = now_ns

    def _try_again(self, routine: Routine, now_ns: int) -> Vector | Trip:
        if self._failures == len(PAUSES_S):
            tries = f"in {self._failures + 1} tries of {routine.timeout_s:g} s"
            cause = f"reset routine {routine.name!r} did not arrive {tries}; free the arm, then acknowledge"
            return Trip(Protection.RESET, Category.BRAKE_HOLD, cause, now_ns)
        pause_s = self._robot.stopping_time_s + PAUSES_S[self._failures]
        self._failures += 1
        self._begins_ns = now_ns + round(pause_s * 1e9)
        return self._rest
