"""P11: a machine that does not keep time."""

from robotctl.hal.robot import Robot
from robotctl.safety.trip import Category, Protection
from robotctl.trials.bench import Bench
from robotctl.trials.faults import Planted
from robotctl.trials.scenario import Scenario
from robotctl.trials.stops import Expected, stop_scenario

_COASTING_REST_S = 0.4
"""Where nobody commanded the drives for a while, they have to be led back first."""
_COASTED_RAD = 0.01
"""The drives go on as they were told last, near a limit past it, until they are spoken to again."""
_LATE = 1.2
"""Servo periods."""


def _late_again(bench: Bench) -> Planted:
    begun = bench.now_ns
    for _ in range(bench.robot.profile.safety.overrun_ticks):
        bench.tick(_LATE)
    return _late_since(bench, begun)


def _gap(bench: Bench) -> Planted:
    begun = bench.now_ns
    bench.tick(1.0 + 1.1 * bench.robot.profile.safety.overrun_s / (bench.robot.period_ns * 1e-9))
    return _late_since(bench, begun)


def _late_since(bench: Bench, begun_ns: int) -> Planted:
    def showed() -> bool:
        return bool(bench.since(begun_ns)["lateness_ns"].max() > bench.robot.period_ns)

    return Planted(lambda: None, showed)


def scenarios(robot: Robot, _backend: str) -> list[Scenario]:
    safety, period = robot.profile.safety, robot.period_ns * 1e-9
    return [
        stop_scenario(
            11,
            "late again and again",
            f"{safety.overrun_ticks} ticks in a row are late by {_LATE:g} periods",
            _late_again,
            Expected(
                protection=Protection.OVERRUN,
                category=Category.BRAKE_HOLD,
                within_s=(1.0 + 2.0 * _LATE) * safety.overrun_ticks * period,
            ),
        ),
        stop_scenario(
            11,
            "stood still",
            "a tick comes later than allowed",
            _gap,
            Expected(
                protection=Protection.OVERRUN,
                category=Category.BRAKE_OFF,
                within_s=1.2 * safety.overrun_s + 2.0 * period,
                rest_s=_COASTING_REST_S,
                beyond={"position": _COASTED_RAD},
            ),
        ),
    ]
