"""Scenarios that need no stop: a hostile policy asks for what is beyond a limit, and the arm does what it may."""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robotctl.hal.robot import Robot
from robotctl.hal.types import Vector
from robotctl.safety.machine import State
from robotctl.safety.shaper import Clip
from robotctl.trials.bench import Bench, Policy
from robotctl.trials.faults import Fault
from robotctl.trials.policies import Act, velocities
from robotctl.trials.scenario import Scenario, Trial
from robotctl.trials.stops import judge_limits, running

_SECONDS = 4.0

Pace = Callable[[Bench], float]
"""How late the next tick is, in servo periods."""


def shaped_scenario(
    number: int,
    name: str,
    provoked: str,
    act: Callable[[Bench], Act],
    asked: Callable[[NDArray[Any], Robot], bool],
    targets: Callable[[Act], Policy] = velocities,
    pace: Pace = lambda _: 0.0,
    start: Callable[[Bench], Vector] = lambda bench: np.array(bench.robot.profile.home),
) -> Scenario:
    """Return the scenario of a hostile policy.

    Args:
        number: of the protection.
        name: of the scenario.
        provoked: what the policy does, in words.
        act: the policy.
        asked: whether it really asked for more than is allowed, by the records.
        targets: how its actions become targets.
        pace: of the ticks.
        start: the pose it begins in.
    """

    def run(robot: Robot, backend: str, seed: int) -> Trial:
        trial = Trial()
        with Bench(robot, backend, seed) as bench:
            bench.place(start(bench))
            bench.start(targets(act(bench)))
            begun = bench.now_ns
            while bench.now_ns - begun < _SECONDS * 1e9 and not bench.trips:
                bench.tick(pace(bench))
            records = bench.since(begun)
        trial.require(bench.state is State.RUN, f"ended in {bench.state.name}: {bench.trips}")
        trial.require(asked(records, robot), "the policy asked for nothing beyond the limit")
        judge_limits(robot, records, frozenset(), trial)
        judge_commands(robot, records, trial)
        trial.seen = "shaped, no stop"
        return trial

    return Scenario(number, name, provoked, "no stop, no limit exceeded", run)


def tolerated_scenario(
    number: int, name: str, provoked: str, fault: Fault, excused: frozenset[str] = frozenset()
) -> Scenario:
    """Return the scenario of a fault that must not stop the arm; `excused` are limits that the fault itself breaks."""

    def run(robot: Robot, backend: str, seed: int) -> Trial:
        trial = Trial()
        with Bench(robot, backend, seed) as bench:
            running(bench)
            onset = bench.now_ns
            planted = fault(bench)
            bench.run(_SECONDS)
            records = bench.since(onset)
            trial.require(planted.showed(), "the fault did not show: it was not there")
        moving = float((np.abs(records["true_velocity"]) / robot.limits.velocity).max(axis=1).mean())
        trial.require(bench.state is State.RUN and moving > 0.1, f"ended in {bench.state.name}: {bench.trips}")
        judge_limits(robot, records, excused, trial)
        trial.seen = "went on"
        return trial

    return Scenario(number, name, provoked, "no stop, no limit exceeded", run)


def clipped(flag: Clip) -> Callable[[NDArray[Any], Robot], bool]:
    """Return the proof that a limit had to act in at least a twentieth of the ticks."""
    return lambda records, _: bool((records["clip"] & flag != 0).mean() > 0.05)


def too_fast(records: NDArray[Any], robot: Robot) -> bool:
    """Return whether more than the velocity caps was wanted in most ticks."""
    return bool((np.abs(records["wanted"]) > robot.limits.velocity).any(axis=1).mean() > 0.5)


def judge_commands(robot: Robot, records: NDArray[Any], trial: Trial) -> None:
    """Require that what was sent kept within the caps on velocity and acceleration."""
    velocity = records["command_velocity"]
    # A late tick makes a step for every period that it missed, one that comes soon after it a whole one.
    periods = np.ceil(np.diff(records["stamp_ns"]) / robot.period_ns - 1e-6)[:, np.newaxis]
    change = np.abs(np.diff(velocity, axis=0)) / (periods * robot.period_ns * 1e-9)
    fast = float((np.abs(velocity) / robot.limits.velocity).max())
    hard = float((change / robot.limits.acceleration).max())
    trial.figures |= {"commanded_velocity": fast, "commanded_acceleration": hard}
    trial.require(fast <= 1.0, f"commanded {fast:.3f} times the velocity cap")
    trial.require(hard <= 1.0 + 1e-6, f"commanded {hard:.3f} times the acceleration cap")
