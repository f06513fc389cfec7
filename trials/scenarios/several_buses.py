"""P14: one of several arms that share a session is not reached any more."""

import errno

import can
import numpy as np

from robotctl.control.operator import Verb
from robotctl.hal.robot import Robot
from robotctl.safety.machine import State
from robotctl.safety.trip import Category, Protection
from robotctl.trials.bench import Bench
from robotctl.trials.scenario import Scenario, Trial
from robotctl.trials.stops import Expected, judge_trip, running

_SLACK_TICKS = 2
_ENDED_S = 1.0
"""After the stopping time: what is not measured any more does not come to rest, and is waited for no longer."""
_SINKING = 1.0
"""rad/s; an arm without brakes that is damped sinks slower."""


def _lost(robot: Robot, backend: str, seed: int) -> Trial:
    """The adapter of one of several arms is unplugged: the others are stopped, and not led on without it."""
    trial = Trial()
    with Bench(robot, backend, seed) as bench:
        running(bench)
        gone = int(bench.random.integers(len(bench.buses)))
        drives = [joint.drive for joint in robot.profile.joints]
        here = [axis for axis, drive in enumerate(drives) if drive and drive.bus != gone]
        bus, onset = bench.buses[gone], bench.now_ns
        bus.failure = can.CanOperationError("a test", errno.ENODEV)
        bench.run(robot.stopping_time_s + _ENDED_S)
        expected = Expected(protection=Protection.BUS, category=Category.BRAKE_OFF, words="check adapter and cable")
        judge_trip(bench.trips, expected, trial)
        if not trial.problems:
            trial.figures["reaction_s"] = (bench.trips[0]["stamp_ns"] - onset) * 1e-9
            trial.require(trial.figures["reaction_s"] <= _SLACK_TICKS * robot.period_ns * 1e-9, "noticed too late")
        speed = np.abs(bench.plant.truth().velocity[here]).max()
        trial.require(speed < _SINKING, f"the arm that is still reached moves at {speed:.2f} rad/s")
        trial.require(not any(drive.enabled for drive in bus.bench.drives), "drives that nobody reaches are still on")
        bus.failure = None
        for verb in (Verb.ARM, Verb.START, Verb.HOME):
            trial.require(bool(bench.ask(verb)), f"{verb.name} led on without an acknowledgement")
        trial.require(bench.state is State.FAULT, f"ended in {bench.state.name}")
        trial.seen = "P14, category 1; both arms stopped"
    return trial


def scenarios(robot: Robot, backend: str) -> list[Scenario]:
    if backend != "can" or robot.profile.buses == 1:
        return []
    return [
        Scenario(
            14,
            "one bus lost",
            "the adapter of one arm is unplugged; it is back when the arms have stopped",
            "P14 category 1 for all arms; nothing goes on by itself",
            _lost,
        )
    ]
