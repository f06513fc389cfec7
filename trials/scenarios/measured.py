"""Faults that show in what is measured."""

from robotctl.hal.robot import Robot
from robotctl.safety.trip import Category, Protection
from robotctl.trials.faults import stuck
from robotctl.trials.scenario import Scenario
from robotctl.trials.stops import Expected, stop_scenario


def scenarios(robot: Robot, backend: str) -> list[Scenario]:
    return [
        stop_scenario(
            17,
            "stuck joint",
            "the fastest joint seizes up",
            stuck,
            Expected(protection=Protection.TRACKING, category=Category.BRAKE_OFF, within_s=0.5),
        ),
    ]
