"""Two arms, each with a bus of its own: what befalls the one does not touch the other."""

import errno

import can
import numpy as np
import pytest

from robotctl.hal.errors import BusError
from robotctl.hal.robot import Robot, load_robot
from robotctl.safety.machine import State
from robotctl.safety.trip import Category
from robotctl.trials.bench import Bench
from robotctl.trials.scenarios import scenarios
from robotctl.trials.stops import running


@pytest.mark.parametrize("name", ["one bus lost", "down and up", "stale frames", "foreign id"])
def test_two_arms_in_one_session_are_stopped_together(name: str) -> None:
    robot = load_robot("openarm_bimanual")
    scenario = next(each for each in scenarios(robot, "can") if each.name == name)
    trial = scenario.run(robot, "can", 0)
    assert trial.problems == []
    assert trial.seen


def test_one_bus_is_lost_and_the_other_arm_goes_on(panda: Robot) -> None:
    with Bench(panda, "can", seed=0) as lost, Bench(panda, "can", seed=1) as alive:
        for bench in (lost, alive):
            running(bench)
        lost.buses[0].failure = can.CanOperationError("a test", errno.ENODEV)
        with pytest.raises(BusError, match="check the adapter"):
            lost.tick()
        lost.take_events()
        assert [(trip["protection"], trip["stop_category"]) for trip in lost.trips] == [("P14", Category.CUT)]
        begun = alive.now_ns
        for _ in range(500):
            lost.let_pass(panda.period_ns)
            alive.tick()
        assert not any(drive.shaft.state()[2] for drive in lost.drives[: panda.dof])
        assert alive.state is State.RUN
        assert alive.trips == []
        assert (np.abs(alive.since(begun)["true_velocity"]).max(axis=1) > 0.05).mean() > 0.9
