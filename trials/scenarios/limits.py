"""P1, P2, P4, P6: limits that the shaper keeps, whatever a policy asks for."""

from robotctl.hal.robot import Robot
from robotctl.safety.shaper import Clip
from robotctl.trials.bench import Bench
from robotctl.trials.policies import against_limits, bang_bang, outward, random
from robotctl.trials.scenario import Scenario
from robotctl.trials.shaping import clipped, shaped_scenario, too_fast

_OFTEN_LATE = 0.15
_LATEST = 2.0
"""Servo periods; three ticks in a row never come so late."""


def jitter(bench: Bench) -> float:
    """Return a lateness for the next tick: intervals between 0.5 and 3 servo periods."""
    if bench.random.random() < _OFTEN_LATE:
        return float(bench.random.uniform(1.0, _LATEST))
    return float(bench.random.uniform(0.0, 0.5))


def scenarios(_robot: Robot, _backend: str) -> list[Scenario]:
    return [
        shaped_scenario(1, "twice the cap", "a policy asks for up to twice every velocity cap", random, too_fast),
        shaped_scenario(
            2,
            "into the limits",
            "a policy pushes every joint against its limits",
            against_limits,
            clipped(Clip.POSITION),
        ),
        shaped_scenario(4, "outward", "a policy pushes the tool out of its sphere", outward, clipped(Clip.SPHERE)),
        shaped_scenario(6, "steps", "a policy asks for full speed to and fro, in steps", bang_bang, too_fast),
        shaped_scenario(
            6,
            "steps under jitter",
            "the same, with ticks 0.5 to 3 servo periods apart",
            bang_bang,
            too_fast,
            pace=jitter,
        ),
    ]
