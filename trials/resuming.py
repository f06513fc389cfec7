"""Scenarios that clear by themselves: a fault that passes in time brakes the arm, which then goes on."""

from collections.abc import Sequence

import numpy as np

from robotctl.hal.robot import Robot
from robotctl.safety.machine import State
from robotctl.trials.bench import Bench
from robotctl.trials.faults import Fault
from robotctl.trials.scenario import Scenario, Trial
from robotctl.trials.stops import Start, judge_limits, running

_AFTER_S = 1.0


def resuming_scenario(
    number: int,
    name: str,
    provoked: str,
    fault: Fault,
    seconds: float,
    trips: Sequence[str] = (),
    start: Start = running,
    repeats: int = 3,
) -> Scenario:
    """Return the scenario of a fault that lasts for `seconds`, with the protections that may trip meanwhile."""

    def run(robot: Robot, backend: str, seed: int) -> Trial:
        trial = Trial()
        with Bench(robot, backend, seed) as bench:
            start(bench)
            onset = bench.now_ns
            planted = fault(bench)
            bench.run(seconds)
            trial.require(planted.showed(), "the fault did not show: it was not there")
            braked = ~bench.since(onset)["wanted"].any(axis=1)
            trial.require(bool(braked.any()), "the arm was not braked")
            planted.undo()
            bench.run(_AFTER_S)
            records = bench.since(onset)
            seen = [trip["protection"] for trip in bench.trips]
            trial.require(seen == list(trips), f"tripped: {seen} instead of {list(trips)}")
            moving = float((np.abs(bench.plant.truth().velocity) / robot.limits.velocity).max())
            trial.require(bench.state is State.RUN and moving > 0.1, f"did not go on: {bench.state.name}")
        trial.seen = f"braked{', ' + ', '.join(seen) if seen else ''}, went on by itself"
        judge_limits(robot, records, frozenset(), trial)
        return trial

    return Scenario(number, name, provoked, "braked; goes on by itself once the cause is gone", run, repeats)
