"""Scenarios that end in a stop: plant a fault under a moving arm, and hold what follows against what is promised."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robotctl.hal.robot import Robot
from robotctl.safety.judge import Judge
from robotctl.safety.machine import State
from robotctl.safety.trip import Category, Protection
from robotctl.trials.bench import Bench
from robotctl.trials.clearing import Clears, go_on
from robotctl.trials.faults import Fault, faulty
from robotctl.trials.measure import measure_stop
from robotctl.trials.policies import sway, velocities
from robotctl.trials.scenario import Scenario, Trial

_LEAD_S = 0.4
_STILL_S = 0.2
_MOMENTS_S = 1.0
_WATCH_S = 1.0
"""How long an arm at rest is watched, with its policy still at work, before the operator does something."""
_DRIFT = 0.02
"""rad; more is a motion."""
_LONGEST_REST_S = 3.0
_SLACK_TICKS = 2
_NEVER_S = 1e3

_STOPPED = (State.HOLD, State.FAULT)

Start = Callable[[Bench], None]
"""Brings a bench from READY to where the fault is to meet it."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Expected:
    """What a fault has to end in."""

    protection: Protection
    category: Category
    clears: Clears = Clears.ACK
    within_s: float = 0.0
    """Longest time from the fault to the first stopping command, beyond two ticks."""
    ends: Category | None = None
    """Category of the stop that is in force in the end, where it becomes harder on its way."""
    rest_s: float | None = None
    """Longest time from that command to rest, where the fault itself keeps the arm from stopping as it should; else
    the published one."""
    or_else: tuple[tuple[Protection, Category], ...] = ()
    """What else may come first, where it depends on the joint and the motion which threshold is passed first."""
    excused: frozenset[str] = frozenset()
    """Invariants that the fault itself breaks: limits as the judge names them, or `drift`."""
    beyond: Mapping[str, float] = field(default_factory=dict)
    """How far beyond a limit, as the judge names it, the fault itself carries the arm at most."""
    words: str = ""
    """What the trip's text has to hold: what a person can do, mostly."""
    note: str = ""
    """What else has to be known, for the report."""

    def __str__(self) -> str:
        names = " or ".join(f"{name} category {category}" for name, category in self.accepted)
        return f"{names}, within {1e3 * self.within_s:.0f} ms; cleared {self.clears.value}{self.note}"

    def losing_torque(self, robot: Robot) -> "Expected":
        """Return the same for a fault that takes the torque away: without brakes the arm falls, whatever is done."""
        if robot.profile.brakes:
            return self
        everything = frozenset({"position", "velocity", "sphere", "drift", "keep_out"})
        return replace(self, rest_s=np.inf, excused=everything, note="; without brakes the arm falls")

    @property
    def accepted(self) -> list[tuple[str, int]]:
        """Label and category of what may come first."""
        pairs = [(self.protection, self.category), *self.or_else]
        return [(protection.label, int(category)) for protection, category in pairs]


def running(bench: Bench, share: float = 1.0) -> None:
    """Let a policy swing the arm about at a share of its caps, until a moment that the seed chooses."""
    bench.start(sway(bench, share))
    bench.run(_LEAD_S + bench.random.uniform(0.0, _MOMENTS_S))


def still(bench: Bench) -> None:
    """Let a policy hold the arm where it is."""
    bench.start(velocities(lambda _time, position: np.zeros_like(position)))
    bench.run(_STILL_S)


def stop_scenario(
    number: int,
    name: str,
    provoked: str,
    fault: Fault,
    expected: Expected,
    start: Start = running,
) -> Scenario:
    """Return the scenario that plants a fault under a moving arm."""

    def run(robot: Robot, backend: str, seed: int) -> Trial:
        trial = Trial()
        with Bench(robot, backend, seed) as bench:
            start(bench)
            if trial.require(not bench.trips, f"stopped before the fault: {bench.trips}"):
                _stop(bench, fault, expected, trial)
        return trial

    return Scenario(number, name, provoked, str(expected), run)


def untouchable(scenario: Scenario) -> Scenario:
    """Return a scenario without the contact reflex, which would be quicker: what stands behind it is tried."""

    def run(robot: Robot, backend: str, seed: int) -> Trial:
        numb = robot.profile.safety.model_copy(update={"contact_time_s": _NEVER_S})
        return scenario.run(replace(robot, profile=robot.profile.model_copy(update={"safety": numb})), backend, seed)

    return replace(scenario, provoked=f"{scenario.provoked}; the contact reflex is off", run=run)


def _stop(bench: Bench, fault: Fault, expected: Expected, trial: Trial) -> None:
    onset = bench.now_ns
    planted = fault(bench)
    bench.until(lambda: bench.state in _STOPPED, expected.within_s + bench.robot.stopping_time_s + 1.0)
    bench.run(_WATCH_S + min(expected.rest_s or 0.0, _LONGEST_REST_S))
    judge_trip(bench.trips, expected, trial)
    hardest = min((trip["stop_category"] for trip in bench.trips), default=Category.BRAKE_HOLD)
    final = State.HOLD if hardest == Category.BRAKE_HOLD else State.FAULT
    trial.require(bench.state is final, f"ended in {bench.state.name} instead of {final.name}")
    trial.require(expected.ends in (None, hardest), f"ended in category {hardest}")
    trial.require(planted.showed(), "the fault did not show: it was not there")
    judge_stop(bench.robot, bench.since(onset), onset, expected, trial)
    if not trial.problems:
        go_on(bench, planted, _clearing(bench, expected), trial)


def _clearing(bench: Bench, expected: Expected) -> Clears:
    """Return what clears a stop: a power cycle as well where a drive has come to a fault in the course of it."""
    if expected.protection is Protection.DRIVE:
        return expected.clears
    failed = bench.trips[0]["protection"] == Protection.DRIVE.label or faulty(bench)
    return Clears.POWER if failed else expected.clears


def judge_trip(trips: Sequence[dict[str, Any]], expected: Expected, trial: Trial) -> None:
    """Require that the right protection tripped first, in its category."""
    if trial.require(bool(trips), "nothing tripped"):
        first = trips[0]
        trial.seen = f"{first['protection']}, category {first['stop_category']}"
        right = (first["protection"], first["stop_category"]) in expected.accepted
        trial.require(right, f"{trial.seen} came first: {first['text']}")
        trial.require(expected.words in first["text"], f"{trial.seen} said: {first['text']}")


def judge_stop(robot: Robot, records: NDArray[Any], onset_ns: int, expected: Expected, trial: Trial) -> None:
    """Measure a stop, and require of it what is published.

    Args:
        robot: that was stopped.
        records: of the ticks from the onset to well after rest.
        onset_ns: when the fault began.
        expected: what it had to end in.
        trial: takes figures and problems.
    """
    stop = measure_stop(records, onset_ns, robot)
    if stop is None:
        trial.require(False, "the arm was not stopped")
        return
    longest = robot.stopping_time_s if expected.rest_s is None else expected.rest_s
    reaction = expected.within_s + _SLACK_TICKS * robot.period_ns * 1e-9
    trial.figures |= {
        "reaction_s": stop.reaction_s,
        "standstill_s": stop.standstill_s,
        "joint_way_rad": stop.joint_way,
        "tool_way_m": stop.tool_way,
    }
    trial.require(
        stop.reaction_s <= reaction, f"reacted after {1e3 * stop.reaction_s:.1f} ms, not {1e3 * reaction:.1f}"
    )
    trial.require(stop.standstill_s <= longest, f"at rest after {stop.standstill_s:.3f} s instead of {longest:.3f} s")
    if "drift" not in expected.excused:
        trial.require(stop.drift < _DRIFT, f"moved on by {stop.drift:.3f} rad after it had come to rest")
    judge_limits(robot, records, expected.excused, trial, expected.beyond)


def judge_limits(
    robot: Robot,
    records: NDArray[Any],
    excused: frozenset[str],
    trial: Trial,
    beyond: Mapping[str, float] = MappingProxyType({}),
) -> None:
    """Require that the invariants held, but for those that the fault itself breaks, and as far as it may."""
    judge = Judge(robot)
    judge.take(records)
    trial.require(judge.on_truth, "judged on measurements, not on the plant's true state")
    for key, ticks in judge.violations.items():
        if np.isfinite(judge.worst[key]):
            trial.figures[f"{key}_excess"] = float(judge.worst[key])
        if key not in excused and judge.worst[key] > beyond.get(key, -np.inf):
            trial.require(ticks == 0, f"{key} limit exceeded by {judge.worst[key]:.4f} in {ticks} ticks")
