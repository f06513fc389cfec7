"""A scenario: one fault, how it is provoked, and what has to come of it."""

from collections.abc import Callable
from dataclasses import dataclass, field

from robotctl.hal.robot import Robot

TITLES = {
    1: "joint velocity cap",
    2: "soft position limit",
    3: "measured position",
    4: "bounding sphere",
    5: "measured tool point",
    6: "acceleration and jerk",
    7: "torque, torque rate, power",
    8: "limits in torque mode",
    9: "malformed action",
    10: "policy heartbeat",
    11: "loop overrun",
    12: "feedback age",
    13: "drive watchdog",
    14: "CAN errors",
    15: "receive integrity",
    16: "guard on encoded frames",
    17: "tracking error",
    18: "measured overspeed",
    19: "contact reflex",
    20: "proximity",
    21: "bumpless start",
    22: "deadman",
    23: "emergency stop",
    24: "drive health",
    25: "configuration",
    26: "weights",
    27: "watchman",
    28: "log, disk, viewer",
    29: "failed reset",
    30: "operator's process",
}
"""All protections by number. Each has to have a scenario, on every robot and backend."""


@dataclass(slots=True)
class Trial:
    """What one repetition of a scenario came to."""

    problems: list[str] = field(default_factory=list)
    """Everything that was not as it has to be; the trial passed if there is nothing."""
    seen: str = ""
    """What happened, in a few words: protection, category, where it ended, what cleared it."""
    figures: dict[str, float] = field(default_factory=dict)
    """What was measured, SI units; the names say which."""

    def require(self, condition: bool, problem: str) -> bool:
        """Note a problem unless something is so; return whether it is."""
        if not condition:
            self.problems.append(problem)
        return condition


@dataclass(frozen=True, slots=True)
class Scenario:
    """One row of the campaign."""

    number: int
    """Of the protection."""
    name: str
    provoked: str
    """How, in words."""
    expected: str
    run: Callable[[Robot, str, int], Trial]
    """Takes robot, backend and seed. May raise: that fails the trial, too."""
    repeats: int = 3
    """With seeds 0, 1, ...: other motions, other moments."""
    real_time: bool = False
    """Whether it needs the machine's own clock, and processes."""

    @property
    def label(self) -> str:
        return f"P{self.number}"
