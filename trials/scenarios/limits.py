"""P1, P2, P4, P6: limits that the shaper keeps, whatever a policy asks for."""

from robotctl.hal.robot import Robot
from robotctl.safety.shaper import Clip
from robotctl.trials.bench import Bench
from robotctl.trials.policies import Act, against_limit, bang_bang, before_limit, outward, random
from robotctl.trials.scenario import Scenario
from robotctl.trials.shaping import clipped, shaped_scenario, too_fast

_OFTEN_LATE = 0.15
_LATEST = 2.0
"""Servo periods, as long as that is ..."""
_LATEST_NS = 6_000_000
"""... no more than what the invariants are promised for."""


def jitter(bench: Bench) -> float:
    """Return a lateness for the next tick: intervals between 0.5 and 3 servo periods, never late twice in a row."""
    if bench.loop.lateness_ns < bench.robot.period_ns and bench.random.random() < _OFTEN_LATE:
        return float(bench.random.uniform(1.0, max(1.0, min(_LATEST, _LATEST_NS / bench.robot.period_ns))))
    return float(bench.random.uniform(0.0, 0.5))


def _random(bench: Bench) -> Act:
    return random(bench.robot, bench.random)


def _outward(bench: Bench) -> Act:
    return outward(bench.robot, bench.random)


def _steps(bench: Bench) -> Act:
    return bang_bang(bench.robot, bench.random)


def scenarios(_robot: Robot, _backend: str) -> list[Scenario]:
    steps, limited = "full speed to and fro, in steps", clipped(Clip.POSITION)
    return [
        shaped_scenario(1, "twice the cap", "a policy asks for up to twice every velocity cap", _random, too_fast),
        shaped_scenario(
            2, "into a limit", "a policy pushes a joint against its limit", against_limit, limited, start=before_limit
        ),
        shaped_scenario(4, "outward", "a policy pushes the tool out of its sphere", _outward, clipped(Clip.SPHERE)),
        shaped_scenario(6, "steps", f"a policy asks for {steps}", _steps, too_fast),
        shaped_scenario(
            6,
            "steps under jitter",
            "the same, with ticks 0.5 to 3 periods apart",
            _steps,
            too_fast,
            pace=jitter,
        ),
    ]
