"""The campaign itself: what it makes of trials, and that every protection has its scenarios."""

from dataclasses import replace

import pytest

from robotctl.hal.robot import Robot, load_robot
from robotctl.trials.campaign import Row, run_campaign
from robotctl.trials.scenario import TITLES, Scenario, Trial
from robotctl.trials.scenarios import scenarios


def good(_robot: Robot, _backend: str, seed: int) -> Trial:
    return Trial(figures={"reaction_s": 0.001 * seed})


def bad_once(_robot: Robot, _backend: str, seed: int) -> Trial:
    return Trial(["it moved"] if seed == 1 else [])


def dies(_robot: Robot, _backend: str, _seed: int) -> Trial:
    raise ZeroDivisionError("in the loop")


def a_scenario(number: int, run=good) -> Scenario:
    return Scenario(number, "a test", "nothing", "nothing", run)


EVERYTHING = [a_scenario(number) for number in TITLES]


def test_a_campaign_passes_if_every_trial_of_every_protection_does(panda: Robot) -> None:
    campaign = run_campaign(panda, "sim", EVERYTHING)
    assert campaign.passed
    assert [len(row.trials) for row in campaign.rows] == [3] * len(TITLES)
    assert campaign.missing == []


def test_one_bad_trial_fails_it(panda: Robot) -> None:
    campaign = run_campaign(panda, "sim", [*EVERYTHING, a_scenario(7, bad_once)])
    assert not campaign.passed
    assert [row.problems for row in campaign.rows if not row.passed] == [["it moved"]]


def test_a_loop_that_dies_is_a_failure_like_any_other(panda: Robot) -> None:
    campaign = run_campaign(panda, "sim", [*EVERYTHING, a_scenario(7, dies)])
    assert not campaign.passed
    assert campaign.rows[-1].problems == ["ZeroDivisionError: in the loop"]


def test_a_protection_without_a_scenario_fails_it(panda: Robot) -> None:
    campaign = run_campaign(panda, "sim", [scenario for scenario in EVERYTHING if scenario.number != 19])
    assert campaign.missing == [19]
    assert not campaign.passed


def test_one_protection_alone(panda: Robot) -> None:
    campaign = run_campaign(panda, "sim", EVERYTHING, only=12)
    assert campaign.passed
    assert [row.scenario.number for row in campaign.rows] == [12]
    assert run_campaign(panda, "sim", [], only=12).missing == [12]


def test_nothing_tried_is_not_passed(panda: Robot) -> None:
    assert not run_campaign(panda, "sim", [replace(a_scenario(number), repeats=0) for number in TITLES]).passed


def test_it_tells_as_it_goes(panda: Robot) -> None:
    told: list[tuple[str, int]] = []

    def tell(row: Row) -> None:
        told.append((row.scenario.label, len(row.trials)))

    run_campaign(panda, "sim", EVERYTHING[:2], tell)
    assert told == [(label, count) for label in ("P1", "P2") for count in range(4)]


@pytest.mark.parametrize(
    ("robot", "backend"),
    [
        ("panda", "sim"),
        ("panda", "can"),
        ("openarm", "sim"),
        ("openarm", "can"),
        ("kinova", "sim"),
        ("xarm7", "sim"),
        ("xarm7", "can"),
    ],
)
def test_every_protection_has_a_scenario(robot: str, backend: str) -> None:
    found = scenarios(load_robot(robot), backend)
    assert {scenario.number for scenario in found} == set(TITLES)
    names = [(scenario.number, scenario.name) for scenario in found]
    assert len(set(names)) == len(names)
    for scenario in found:
        assert scenario.provoked
        assert scenario.expected
        assert scenario.repeats > 0
