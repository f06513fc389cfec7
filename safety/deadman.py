"""P22: the deadman's switch. Where there is one, the arm moves only while a person holds it."""

from enum import IntEnum

from robotctl.hal.robot import Robot
from robotctl.safety.trip import Category, Protection, Trip


class Grip(IntEnum):
    """What a switch with three positions tells."""

    NONE = 0
    """There is no switch."""
    RELEASED = 1
    HELD = 2
    SQUEEZED = 3
    """Pressed through, as in panic."""
    UNPLUGGED = 4


class Deadman:
    """Judges the switch. Without one everything is permitted."""

    def __init__(self, robot: Robot) -> None:
        self._stuck_ns = round(robot.profile.safety.deadman_stuck_s * 1e9)
        self._grip = Grip.NONE
        self._pressed_ns: int
        """When it began to tell what it tells now."""
        self.permits = True
        """Whether the arm may move."""

    def take(self, grip: Grip, now_ns: int) -> None:
        """Take what the switch tells now. One that is held without end counts as stuck, until it is let go."""
        if grip is not self._grip:
            self._grip, self._pressed_ns = grip, now_ns
        self.permits = grip is Grip.NONE or (grip is Grip.HELD and now_ns - self._pressed_ns < self._stuck_ns)

    def check(self, now_ns: int) -> Trip | None:
        """Trip while the switch does not permit motion: category 2, squeezed 1."""
        if self.permits:
            return None
        if self._grip is Grip.SQUEEZED:
            cause = "the deadman's switch was squeezed; release it, then acknowledge"
            return Trip(Protection.DEADMAN, Category.BRAKE_OFF, cause, now_ns)
        how = "has been held for too long" if self._grip is Grip.HELD else f"is {self._grip.name.lower()}"
        cause = f"the deadman's switch {how}; press it anew to go on"
        return Trip(Protection.DEADMAN, Category.BRAKE_HOLD, cause, now_ns)
