"""Scenarios in which nobody is left to stop the arm but its drives themselves."""

from collections.abc import Callable

import numpy as np

from robotctl.hal.errors import BusError
from robotctl.hal.robot import Robot
from robotctl.trials.bench import Bench
from robotctl.trials.faults import on_canopen
from robotctl.trials.scenario import Scenario, Trial
from robotctl.trials.stops import running

_WATCH_MS = 1500
_LOOP_S = 0.5
_QUICK_STOP_S = 0.1


def nobody(_bench: Bench, _trial: Trial) -> None:
    """The loop is just not heard of any more."""


def without_bus(bench: Bench, trial: Trial) -> None:
    """The loop reports that its bus is gone, and ends."""
    try:
        bench.run(_LOOP_S)
    except BusError:
        bench.take_events()
    last = [(trip["protection"], trip["stop_category"]) for trip in bench.trips[-1:]]
    trial.require(last == [("P14", 0)], f"the loop ended with {last}")


def orphan_scenario(
    number: int,
    name: str,
    provoked: str,
    plant: Callable[[Bench], None] = lambda _: None,
    ending: Callable[[Bench, Trial], None] = nobody,
) -> Scenario:
    """Return the scenario of an arm that is left alone under way.

    Args:
        number: of the protection.
        name: of the scenario.
        provoked: what happens, in words.
        plant: a fault.
        ending: lets the loop end of it.
    """

    def run(robot: Robot, backend: str, seed: int) -> Trial:
        trial = Trial()
        with Bench(robot, backend, seed) as bench:
            running(bench)
            plant(bench)
            ending(bench, trial)
            _watch(bench, trial)
        return trial

    return Scenario(number, name, provoked, "every drive goes off by itself, in the time it has", run)


def _watch(bench: Bench, trial: Trial) -> None:
    """Let time pass without a loop, looking at the plant once in a millisecond."""
    robot = bench.robot
    states = []
    for _ in range(_WATCH_MS):
        states.append(bench.plant.truth())
        bench.let_pass(1_000_000)
    torque = np.abs([state.effort for state in states]).max(axis=1)
    off = int(np.argmin(torque > 0.0)) if not torque.all() else len(torque)
    timeout_ms = 1e3 * robot.profile.safety.drive_timeout_s
    if on_canopen(robot) and bench.backend == "can":
        timeout_ms += 1e3 * _QUICK_STOP_S  # they slow down first
    trial.seen = "drives off by themselves"
    trial.figures["reaction_s"] = 1e-3 * off
    trial.require(off <= timeout_ms, f"the drives were off after {off} ms instead of {timeout_ms:.0f}")
    trial.require(not torque[off:].any(), "torque came back")
    if not robot.profile.brakes:
        trial.seen += "; without brakes the arm falls"
        return
    fast = np.abs([state.velocity for state in states]).max(axis=1) >= robot.profile.safety.standstill
    rest = max(int(np.flatnonzero(fast)[-1]) + 1 - off, 0) if fast.any() else 0
    position, tool = np.array([state.position for state in states]), np.array([state.tool for state in states])
    trial.figures |= {
        "standstill_s": 1e-3 * rest,
        "joint_way_rad": float(np.abs(position - position[0]).max()),
        "tool_way_m": float(np.linalg.norm(tool - tool[0], axis=1).max()),
    }
    trial.require(1e-3 * rest <= robot.stopping_time_s, f"at rest {rest} ms after the drives went off")
