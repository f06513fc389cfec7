"""A short soak: hostile policies on all robots, in both modes. `robotctl bench soak` runs it by the million ticks."""

import pytest

from robotctl.hal.robot import robot_names
from robotctl.safety.routines import Goto
from robotctl.trials import soak
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


def test_an_arm_that_finds_no_way_home_is_freed_by_hand_and_goes_on(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(soak, "_EPISODE_S", 1.0)
    monkeypatch.setattr(Goto, "timeout_s", 0.1)
    result = run(Case("kinova", "velocity", "random", "sim", 8000, seed=1))
    assert result["freed"] == result["trips"]["P29"] > 0
    assert result["ticks"] >= 8000
    assert not any(result["violations"].values()), result
    assert result["ended"] == ""
