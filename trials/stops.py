"""Scenarios that end in a stop: plant a fault under a moving arm, and hold what follows against what is promised."""

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum

import numpy as np

from robotctl.control.loop import Verb
from robotctl.hal.robot import Robot
from robotctl.safety.judge import Judge
from robotctl.safety.machine import State
from robotctl.safety.target import Target
from robotctl.safety.trip import Category, Protection
from robotctl.trials.bench import Bench, Policy
from robotctl.trials.faults import Fault, Planted
from robotctl.trials.measure import measure_stop
from robotctl.trials.scenario import Scenario, Trial

_LEAD_S = 0.4
_MOMENTS_S = 1.0
_WATCH_S = 1.0
"""How long an arm at rest is watched before the operator does something."""
_DRIFT = 0.02
"""rad; more is a motion."""
_SLACK_TICKS = 2


class Clears(Enum):
    """What it takes to go on."""

    ITSELF = "by itself"
    START = "by start"
    ACK = "by ack"
    POWER = "by a power cycle, then ack"


@dataclass(frozen=True, kw_only=True, slots=True)
class Expected:
    """What a fault has to end in."""

    protection: Protection
    category: Category
    clears: Clears = Clears.ACK
    within_s: float
    """Longest time from the fault to the first stopping command, beyond two ticks."""
    excused: frozenset[str] = frozenset()
    """Invariants that the fault itself breaks: limits as the judge names them, `rest`, `drift`."""

    def __str__(self) -> str:
        return f"category {int(self.category)} within {1e3 * self.within_s:.0f} ms; cleared {self.clears.value}"


def sway(bench: Bench) -> Policy:
    """Return a policy that swings every joint at up to its cap, once in two seconds, each with a phase of its own."""
    cap = bench.robot.limits.velocity
    phase = bench.random.uniform(0.0, 2.0 * np.pi, cap.shape)

    def act(bench: Bench, time: float) -> Target:
        return bench.velocity(cap * np.sin(np.pi * time + phase))

    return act


def stop_scenario(
    number: int,
    name: str,
    provoked: str,
    fault: Fault,
    expected: Expected,
    policy: Callable[[Bench], Policy] = sway,
    repeats: int = 3,
) -> Scenario:
    """Return the scenario that plants a fault under a moving arm."""

    def run(robot: Robot, backend: str, seed: int) -> Trial:
        trial = Trial()
        with Bench(robot, backend, seed) as bench:
            bench.start(policy(bench))
            bench.run(_LEAD_S + bench.random.uniform(0.0, _MOMENTS_S))
            if trial.require(bench.state is State.RUN, f"in {bench.state.name} before the fault: {bench.trips}"):
                _stop(bench, fault, expected, trial)
        return trial

    return Scenario(number, name, provoked, f"{expected.protection.label}, {expected}", run, repeats)


def _stop(bench: Bench, fault: Fault, expected: Expected, trial: Trial) -> None:
    robot = bench.robot
    onset = bench.now_ns
    planted = fault(bench)
    final = State.HOLD if expected.category is Category.BRAKE_HOLD else State.FAULT
    bench.until(lambda: bench.state is final, expected.within_s + robot.stopping_time_s + 1.0)
    bench.run(_WATCH_S)
    records = bench.since(onset)
    _judge_trip(bench, expected, final, trial)
    stop = measure_stop(records, onset, robot)
    trial.require(planted.showed(), "the fault did not show: it was not there")
    if stop is None:
        trial.require(False, "the arm was not stopped")
        return
    slack = _SLACK_TICKS * robot.period_ns * 1e-9
    trial.figures |= {
        "reaction_s": stop.reaction_s,
        "standstill_s": np.inf if stop.standstill_s is None else stop.standstill_s,
        "joint_way_rad": stop.joint_way,
        "tool_way_m": stop.tool_way,
    }
    trial.require(
        stop.reaction_s <= expected.within_s + slack,
        f"reacted after {1e3 * stop.reaction_s:.1f} ms instead of {1e3 * expected.within_s:.1f} ms",
    )
    if "rest" not in expected.excused:
        trial.require(
            stop.standstill_s is not None and stop.standstill_s <= robot.stopping_time_s,
            f"at rest after {trial.figures['standstill_s']:.3f} s instead of {robot.stopping_time_s:.3f} s",
        )
    if "drift" not in expected.excused:
        trial.require(stop.drift < _DRIFT, f"moved on by {stop.drift:.3f} rad after it had come to rest")
    judge = Judge(robot)
    judge.take(records)
    for key, ticks in judge.violations.items():
        if np.isfinite(judge.worst[key]):
            trial.figures[f"{key}_excess"] = float(judge.worst[key])
        if key not in expected.excused:
            trial.require(ticks == 0, f"{key} limit exceeded by {judge.worst[key]:.4f} in {ticks} ticks")
    _clear(bench, planted, expected, trial)


def _judge_trip(bench: Bench, expected: Expected, final: State, trial: Trial) -> None:
    if not trial.require(bool(bench.trips), "nothing tripped"):
        return
    trip = bench.trips[0]
    trial.seen = f"{trip['protection']}, category {trip['stop_category']}, {bench.state.name}"
    trial.require(
        trip["protection"] == expected.protection.label, f"{trip['protection']} tripped first: {trip['text']}"
    )
    trial.require(trip["stop_category"] == int(expected.category), f"category {trip['stop_category']}")
    trial.require(bench.state is final, f"ended in {bench.state.name} instead of {final.name}")


def _clear(bench: Bench, planted: Planted, expected: Expected, trial: Trial) -> None:
    """Undo the fault and go on as an operator would; a shorter way than the rule says must not lead on."""
    trial.require(bool(bench.ask(Verb.ARM)), "could be armed while stopped")
    if expected.clears is not Clears.START:
        trial.require(bool(bench.ask(Verb.START)), "START alone led on")
    planted.undo()
    bench.policy = None
    if bench.state is State.FAULT:
        _recover_from_fault(bench, trial)
    elif expected.clears is Clears.ACK:
        trial.require(not bench.ask(Verb.ACK), "ACK was refused")
    if trial.problems:
        return
    trips = len(bench.trips)
    bench.hand_over(sway(bench))
    bench.run(0.3)
    moving = float(np.abs(bench.plant.truth().velocity / bench.robot.limits.velocity).max())
    trial.require(bench.state is State.RUN and moving > 0.1, f"did not move again: {bench.trips[trips:]}")
    trial.seen += f", cleared {expected.clears.value}"


def _recover_from_fault(bench: Bench, trial: Trial) -> None:
    text = bench.ask(Verb.ACK)
    if "lowered" in text:
        bench.run(3.0)
        bench.plant.place(np.array(bench.robot.profile.home))
        text = bench.ask(Verb.ACK)
    if trial.require(not text, f"ACK was refused: {text}"):
        trial.require(bench.state is State.READY, f"ACK led to {bench.state.name}")
        trial.require(not bench.ask(Verb.ARM), "ARM was refused")
        bench.run(0.05)
