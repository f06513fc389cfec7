"""A short soak: hostile policies on all robots, in both modes. `robotctl bench soak` runs it by the million ticks."""

import pytest

from robotctl.hal.robot import robot_names
from robotctl.trials.soak import POLICIES, Case, cases, run

TICKS = 4_700
"""Of one case; 150,000 together."""


@pytest.mark.parametrize("robot", robot_names())
@pytest.mark.parametrize("policy", POLICIES)
@pytest.mark.parametrize("mode", ["velocity", "torque"])
def test_nothing_is_violated(robot: str, policy: str, mode: str) -> None:
    result = run(Case(robot, mode, policy, "sim", TICKS, seed=1))
    assert result["ticks"] >= TICKS
    assert result["judged"] > 0.8 * TICKS
    assert not any(result["violations"].values()), result
    assert result["guard_trips"] == 0
    assert result["ended"] == ""


def test_the_ticks_are_shared_evenly() -> None:
    shared = list(cases(["panda", "kinova"], 4_000_000))
    assert sum(case.ticks for case in shared) == 4_000_000
    for robot in ("panda", "kinova"):
        for mode in ("velocity", "torque"):
            for policy in POLICIES:
                mine = [case for case in shared if (case.robot, case.mode, case.policy) == (robot, mode, policy)]
                assert sum(case.ticks for case in mine) == 250_000
    assert len({(case.robot, case.mode, case.policy, case.seed) for case in shared}) == len(shared)
