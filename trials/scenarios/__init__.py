"""Every scenario there is, by the protection that it provokes."""

from robotctl.hal.errors import ConfigError
from robotctl.hal.robot import Robot
from robotctl.trials.scenario import Scenario
from robotctl.trials.scenarios import (
    bereft,
    bus,
    cable,
    configuration,
    contact,
    guarded,
    limits,
    machine,
    measured,
    operator,
    policy,
    processes,
    proximity,
    several_buses,
    weights,
)

_MODULES = (
    limits,
    guarded,
    measured,
    policy,
    machine,
    bus,
    cable,
    several_buses,
    operator,
    contact,
    proximity,
    configuration,
    weights,
    processes,
    bereft,
)


def scenarios(robot: Robot, backend: str) -> list[Scenario]:
    """Return the scenarios of a robot on a backend, in the order of the protections.

    Raises:
        ConfigError: if there is no simulated plant behind that backend.
    """
    if backend not in ("sim", "can"):
        raise ConfigError(f"no faults can be planted on backend {backend!r}", "use sim, or can for emulated motors")
    if backend == "can" and robot.profile.can is None:
        raise ConfigError(f"robot {robot.profile.name!r} has no CAN drives", "use --backend sim")
    found = [scenario for module in _MODULES for scenario in module.scenarios(robot, backend)]
    return sorted(found, key=lambda scenario: scenario.number)
