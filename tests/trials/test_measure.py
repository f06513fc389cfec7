"""Figures of a stop, on records made by hand."""

import numpy as np
import pytest

from robotctl.control.shared import tick_dtype
from robotctl.hal.robot import Robot
from robotctl.safety.machine import State
from robotctl.trials.measure import measure_stop

MS = 1_000_000


def records(speeds, states, period_ms=2):
    """One joint moves at some speeds, rad/s, the tool at a tenth of that; one record per period."""
    made = np.zeros(len(speeds), tick_dtype(7))
    made["stamp_ns"] = np.arange(len(speeds)) * period_ms * MS
    made["state"] = states
    made["true_velocity"][:, 3] = speeds
    made["true_position"][:, 3] = np.cumsum(speeds) * period_ms * 1e-3
    made["true_tool"][:, 1] = 0.1 * made["true_position"][:, 3]
    return made


def braking(ticks=10, reaction=5, braking=20, after=100):
    """Full speed until the stop begins, then down to nothing, evenly."""
    speeds = [1.0] * (ticks + reaction) + list(np.linspace(1.0, 0.0, braking)) + [0.0] * after
    states = [State.RUN] * (ticks + reaction) + [State.STOPPING] * braking + [State.HOLD] * after
    return records(speeds, states)


def test_reaction_standstill_and_ways(panda: Robot) -> None:
    made = braking()
    stop = measure_stop(made[10:], 10 * 2 * MS, panda)
    assert stop.reaction_s == pytest.approx(5 * 0.002)
    # From 1 to 0.05 rad/s in 20 steps is the twentieth; then it counts as at rest.
    assert stop.standstill_s == pytest.approx(19 * 0.002)
    way = float(np.sum(np.linspace(1.0, 0.0, 20)) + 4) * 0.002
    assert stop.joint_way == pytest.approx(way)
    assert stop.tool_way == pytest.approx(0.1 * way)
    assert stop.drift == 0.0


def test_what_a_tick_took_counts_into_the_reaction(panda: Robot) -> None:
    made = braking()
    made["duration_ns"] = MS // 2
    assert measure_stop(made, 20 * MS, panda).reaction_s == pytest.approx(0.0105)


def test_no_stop(panda: Robot) -> None:
    assert measure_stop(records([1.0] * 9, [State.RUN] * 9), 0, panda) is None


def test_a_stop_of_before_the_fault_is_none(panda: Robot) -> None:
    states = [State.STOPPING] * 3 + [State.RUN] * 6
    assert measure_stop(records([1.0] * 9, states), 5 * 2 * MS, panda) is None


def test_an_arm_that_never_comes_to_rest(panda: Robot) -> None:
    stop = measure_stop(records([1.0] * 9, [State.STOPPING] * 9), 0, panda)
    assert stop.standstill_s == np.inf
    assert stop.drift == np.inf


def test_an_arm_that_moves_again_was_not_at_rest(panda: Robot) -> None:
    made = braking()
    made["true_velocity"][-10, 0] = 0.06
    assert measure_stop(made, 20 * MS, panda).standstill_s > 0.2


def test_an_arm_that_creeps_drifts(panda: Robot) -> None:
    made = braking()
    made["true_position"][-100:, 2] = np.linspace(0.0, 0.1, 100)
    made["true_velocity"][-100:, 2] = 0.04  # below what counts as a motion
    assert measure_stop(made, 20 * MS, panda).drift == pytest.approx(0.1, abs=0.01)
