"""Every scenario there is, by the protection that it provokes."""

from robotctl.hal.robot import Robot
from robotctl.trials.scenario import Scenario
from robotctl.trials.scenarios import (
    bereft,
    bus,
    configuration,
    guarded,
    limits,
    machine,
    measured,
    operator,
    policy,
    processes,
    proximity,
    weights,
)

_MODULES = (
    limits,
    guarded,
    measured,
    policy,
    machine,
    bus,
    operator,
    proximity,
    configuration,
    weights,
    processes,
    bereft,
)


def scenarios(robot: Robot, backend: str) -> list[Scenario]:
    """Return the scenarios of a robot on a backend, in the order of the protections."""
    found = [scenario for module in _MODULES for scenario in module.scenarios(robot, backend)]
    return sorted(found, key=lambda scenario: scenario.number)
