"""A run in real time, with everything it has of processes, under way: what the scenarios with signals strike at."""

import os
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robotctl.control.kinematics import Kinematics
from robotctl.control.process_session import ProcessSession
from robotctl.control.recording_session import SessionRecording, record_session
from robotctl.hal.robot import Robot
from robotctl.learning.actor import ProcessActor
from robotctl.learning.task import load_task
from robotctl.safety.machine import State
from robotctl.trials.scenario import Scenario, Trial
from robotctl.trials.stops import Expected, judge_stop, judge_trip

_LEAD_S = 0.6
_MOMENTS_S = 0.6
_AFTER_S = 1.5
_TASK = "reach"
_POLICY = "random"
_RUNTIME_DIR = "ROBOTCTL_RUNTIME_DIR"
LATE_S = 0.02
"""By how much a loop without a real-time kernel may be late."""
ATTEMPTS = 3
"""Times that a trial is begun on a machine that is busy."""
_BUSY = {"P10", "P11", "P30"}
"""What stops an arm whose machine is busy with other things."""


@dataclass(frozen=True, slots=True)
class Live:
    """One run: its session, its policy, its recording."""

    session: ProcessSession
    actor: ProcessActor
    recording: SessionRecording

    @property
    def pids(self) -> dict[str, int]:
        """Of everything that can be struck at."""
        found = {**self.recording.processes, "policy": self.actor.pid}
        return {name: pid for name, pid in found.items() if pid is not None}

    def since(self, stamp_ns: int) -> NDArray[Any]:
        """Return the records of the ticks from a time on."""
        records, _, _ = self.session.link.ticks.since(0)
        return records[records["stamp_ns"] >= stamp_ns]


Strike = Callable[[Live], None]
"""Does something to a run, and lets as much time pass as it takes."""


@contextmanager
def under_way(
    robot: Robot, backend: str, seed: int, channel: Callable[[], str] = lambda: "", overrides: tuple[str, ...] = ()
) -> Iterator[Live]:
    """Run a random policy on an arm, in a runtime folder of its own, until a moment that the seed chooses."""
    task = load_task(_TASK)
    before = os.environ.get(_RUNTIME_DIR)
    with tempfile.TemporaryDirectory() as folder:
        os.environ[_RUNTIME_DIR] = folder
        session = ProcessSession(robot, backend, channel(), overrides)
        actor = ProcessActor(session, task, _POLICY, seed, overrides)
        path = Path(folder) / "run.mcap"
        try:
            with session, record_session(session, path, {}, lambda _: None, overrides) as recording, actor:
                session.prepare()
                actor.begin(task.goal(robot, Kinematics(robot), seed, 0))
                session.begin()
                moment = np.random.default_rng(seed).uniform(0.0, _MOMENTS_S)
                session.advance(_LEAD_S + float(moment))
                yield Live(session, actor, recording)
        finally:
            os.environ.pop(_RUNTIME_DIR)
            if before is not None:
                os.environ[_RUNTIME_DIR] = before


def live_stop_scenario(
    number: int, name: str, provoked: str, strike: Strike, expected: Expected, repeats: int = 1
) -> Scenario:
    """Return the scenario that strikes at a run and expects it to stop."""

    def attempt(live: Live, trial: Trial) -> None:
        onset = time.monotonic_ns()
        strike(live)
        live.session.advance(_AFTER_S)
        judge_trip(live.session.trips, expected, trial)
        judge_stop(live.session.robot, live.since(onset), onset, expected, trial)
        trial.seen += f", {live.session.state.name}"

    run = _patiently(attempt, {label for label, _ in expected.accepted})
    return Scenario(number, name, f"{provoked}; in real time", str(expected), run, repeats, real_time=True)


def live_tolerated_scenario(
    number: int,
    name: str,
    provoked: str,
    strike: Strike,
    problem: str = "",
    trips: tuple[str, ...] = (),
) -> Scenario:
    """Return the scenario that strikes at a run which has to go on.

    Args:
        number: of the protection.
        name: of the scenario.
        provoked: what is done, in words.
        strike: does it.
        problem: words that the recording's problems have to hold in the end; without any there must be none.
        trips: labels of what may stop the arm meanwhile, as long as it clears by itself.
    """

    def attempt(live: Live, trial: Trial) -> None:
        strike(live)
        live.session.advance(_AFTER_S)
        seen = tuple(trip["protection"] for trip in live.session.trips)
        trial.require(seen == trips, f"tripped: {list(seen)} instead of {list(trips)}")
        trial.require(live.session.state is State.RUN, f"did not go on: {live.session.state.name}")
        violations = live.session.judge.violations
        trial.require(not any(violations.values()), f"violated: {violations}")
        trial.seen = "went on" + (f" after {', '.join(seen)}" if seen else "")

    def recorded(live: Live, trial: Trial) -> None:
        told = "; ".join(live.recording.problems)
        trial.require(problem in told if problem else not told, f"of the recording was said: {told or 'nothing'}")

    run = _patiently(attempt, set(trips), recorded)
    return Scenario(number, name, f"{provoked}; in real time", "the run goes on", run, real_time=True)


def _patiently(
    attempt: Callable[[Live, Trial], None],
    expected: set[str],
    afterwards: Callable[[Live, Trial], None] = lambda *_: None,
) -> Callable[[Robot, str, int], Trial]:
    """Return what runs a trial, again if the machine was too busy for it: if the arm was stopped for that alone."""

    def run(robot: Robot, backend: str, seed: int) -> Trial:
        for count in range(ATTEMPTS):
            trial = Trial()
            with under_way(robot, backend, seed + 100 * count) as live:
                if not live.session.trips:
                    attempt(live, trial)
                unexpected = Counter(trip["protection"] for trip in live.session.trips) - Counter(expected)
            afterwards(live, trial)
            if not _BUSY & set(unexpected):
                break
            trial.require(False, "the machine was too busy")
        if count:
            trial.seen += f" (attempt {count + 1}; the machine was busy)"
        return trial

    return run
