"""Backends are found by entry point, so that anybody can add one from a package of their own.

Group `robotctl.backends`: a callable `(robot, clock, channel) -> Rig`. Group `robotctl.channels`: a callable
`(robot, clock) -> Channel`, for CAN channels that python-can does not know.
"""

from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import entry_points

from robotctl.hal.arm import Arm, Gripper
from robotctl.hal.clock import Clock
from robotctl.hal.errors import ConfigError
from robotctl.hal.robot import Robot


@dataclass(frozen=True, slots=True)
class Rig:
    """An arm and, where there is one, its gripper."""

    arm: Arm
    gripper: Gripper | None


BackendFactory = Callable[[Robot, Clock, str], Rig]


def open_backend(name: str, robot: Robot, clock: Clock, channel: str = "") -> Rig:
    """Build the named backend for a robot. Nothing is opened before `rig.arm.connect()`.

    Args:
        channel: where the drives are, for backends that have a choice; "" for the backend's default.

    Raises:
        ConfigError: if there is no such backend, or it cannot carry this robot.
    """
    found = {entry.name: entry for entry in entry_points(group="robotctl.backends")}
    if name not in found:
        raise ConfigError(f"unknown backend {name!r}", f"use one of {', '.join(sorted(found))}")
    factory: BackendFactory = found[name].load()
    return factory(robot, clock, channel)
