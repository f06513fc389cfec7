"""The scenarios: they pass, each on its own; and they fail where a protection is missing, or a fault is not there."""

from dataclasses import replace

import numpy as np
import pytest

from robotctl.control.limiter import VelocityLimiter
from robotctl.control.neighbours import Neighbours
from robotctl.hal.robot import Robot, load_robot
from robotctl.safety.admission import Admission
from robotctl.safety.believable import Believable
from robotctl.safety.contact import ContactReflex
from robotctl.safety.deadman import Deadman
from robotctl.safety.drives import BusHealth, DriveHealth
from robotctl.safety.guard import Guard
from robotctl.safety.overrun import Overrun
from robotctl.safety.protections import FeedbackAge, PositionBreach, SphereBreach
from robotctl.safety.proximity import ProximityBreach
from robotctl.safety.shaper import Shaped, Shaper
from robotctl.safety.tracking import Overspeed, TrackingError
from robotctl.safety.trip import Category, Protection
from robotctl.safety.weights import WeightsGate
from robotctl.trials.bench import Bench
from robotctl.trials.campaign import run_campaign
from robotctl.trials.clearing import Clears
from robotctl.trials.faults import Planted, failed, mute
from robotctl.trials.resuming import resuming_scenario
from robotctl.trials.scenario import Scenario
from robotctl.trials.scenarios import scenarios
from robotctl.trials.stops import Expected, stop_scenario


def in_lockstep(robot: Robot, backend: str, number: int | None = None) -> list[Scenario]:
    """Each once, without those that need real time."""
    found = [each for each in scenarios(robot, backend) if not each.real_time and number in (None, each.number)]
    return [replace(each, repeats=1) for each in found]


ALL = [
    pytest.param(robot, backend, scenario, id=f"{robot}-{backend}-{scenario.label}-{scenario.name}")
    for robot, backend in (("panda", "sim"), ("openarm", "can"))
    for scenario in in_lockstep(load_robot(robot), backend)
]


@pytest.mark.parametrize(("robot", "backend", "scenario"), ALL)
def test_it_passes(robot: str, backend: str, scenario: Scenario) -> None:
    trial = scenario.run(load_robot(robot), backend, 0)
    assert trial.problems == []
    assert trial.seen


def nothing(*_args: object, **_more: object) -> None:
    return None


def unscreened(_self: Believable, sample: object) -> object:
    return sample


def unshaped(_self: Shaper, _position: object, _velocity: object, wanted: object, *_: object) -> Shaped:
    return Shaped(wanted, 0)


def unlimited(_self: VelocityLimiter, wanted: object, *_: object) -> object:
    return np.array(wanted)


def no_words(*_args: object) -> str:
    return ""


MUTATIONS = {
    1: [(VelocityLimiter, "step", unlimited), (Shaper, "step", unshaped), (Guard, "command", no_words)],
    2: [(Shaper, "step", unshaped)],
    3: [(PositionBreach, "check", nothing)],
    4: [(Shaper, "step", unshaped)],
    5: [(SphereBreach, "check", nothing)],
    6: [(Guard, "command", no_words)],
    7: [(Guard, "command", no_words)],
    9: [(Admission, "offer", nothing)],
    10: [(Admission, "heartbeat", nothing)],
    11: [(Overrun, "check", nothing)],
    12: [(FeedbackAge, "check", nothing)],
    14: [(BusHealth, "check", nothing)],
    15: [(Believable, "check", nothing)],
    16: [(Guard, "command", no_words)],
    17: [(TrackingError, "check", nothing)],
    18: [(Overspeed, "check", nothing)],
    19: [(ContactReflex, "check", nothing)],
    20: [(ProximityBreach, "check", nothing)],
    21: [(Guard, "command", no_words)],
    22: [(Deadman, "check", nothing)],
    23: [(Bench, "ask", no_words)],
    24: [(DriveHealth, "check", nothing)],
    26: [(WeightsGate, "offer", nothing)],
    29: [(TrackingError, "check", nothing), (ContactReflex, "check", nothing)],
    30: [(Neighbours, "check", nothing)],
}
"""What each protection is switched off with."""


@pytest.mark.parametrize("number", MUTATIONS)
def test_without_its_protection_it_fails(panda: Robot, monkeypatch: pytest.MonkeyPatch, number: int) -> None:
    for owner, name, instead in MUTATIONS[number]:
        monkeypatch.setattr(owner, name, instead)
    found = in_lockstep(panda, "sim", number)
    assert found
    assert not run_campaign(panda, "sim", found, only=number).passed


# -- the drivers ---------------------------------------------------------------------------------------------------

SILENT = Expected(protection=Protection.FEEDBACK, category=Category.BRAKE_OFF, within_s=0.05)


def no_fault(_bench: Bench) -> Planted:
    return Planted(lambda: None, lambda: False)


def a_stop(fault, expected=SILENT) -> Scenario:
    return stop_scenario(12, "a test", "a test", fault, expected)


def one_mute(bench: Bench) -> Planted:
    return mute(bench, [1])


def test_a_fault_that_is_not_there_is_noticed(panda: Robot) -> None:
    problems = a_stop(no_fault).run(panda, "sim", 0).problems
    assert "the fault did not show: it was not there" in problems
    assert "nothing tripped" in problems


@pytest.mark.parametrize(
    ("expected", "words"),
    [
        (replace(SILENT, protection=Protection.TRACKING), "P12, category 1 came first"),
        (replace(SILENT, category=Category.BRAKE_HOLD), "P12, category 1 came first"),
        (replace(SILENT, within_s=0.03), "reacted after"),
        (replace(SILENT, rest_s=0.05), "at rest after"),
        (replace(SILENT, clears=Clears.POWER), "ACK was enough without a power cycle"),
    ],
)
def test_what_is_not_as_expected_is_noticed(panda: Robot, expected: Expected, words: str) -> None:
    assert a_stop(one_mute).run(panda, "sim", 0).problems == []
    assert words in "; ".join(a_stop(one_mute, expected).run(panda, "sim", 0).problems)


def test_a_stop_that_clears_by_less_than_it_should_is_noticed(panda: Robot) -> None:
    def fail(bench: Bench) -> Planted:
        return failed(bench, 2)

    drive = Expected(
        protection=Protection.DRIVE,
        category=Category.BRAKE_OFF,
        rest_s=1.5,
        clears=Clears.POWER,
        excused=frozenset({"sphere"}),
    )
    assert a_stop(fail, drive).run(panda, "sim", 0).problems == []
    assert "ACK was refused" in "; ".join(a_stop(fail, replace(drive, clears=Clears.ACK)).run(panda, "sim", 0).problems)


def test_an_arm_that_goes_on_without_being_braked_is_noticed(panda: Robot) -> None:
    def harmless(_bench: Bench) -> Planted:
        return Planted(lambda: None, lambda: True)

    problems = resuming_scenario(12, "a test", "a test", harmless, 0.03).run(panda, "sim", 0).problems
    assert problems == ["the arm was not braked"]


@pytest.mark.parametrize("backend", ["sim", "can"])
def test_the_same_seed_gives_the_same_trial(panda: Robot, backend: str) -> None:
    one, other, another = (a_stop(one_mute).run(panda, backend, seed) for seed in (1, 1, 2))
    assert one.figures == other.figures
    assert one.figures != another.figures
