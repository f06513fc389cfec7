"""What a policy is: a map from an observation to joint velocities, 20 times a second.

Whatever it returns is wrapped in a target and admitted, or not, by the supervisor.
"""

from abc import ABC, abstractmethod
from typing import NamedTuple

from robotctl.hal.types import Vector


class Observation(NamedTuple):
    """What a policy sees."""

    position: Vector
    """Measured joints (n,), rad."""
    velocity: Vector
    """(n,), rad/s"""
    tool: Vector
    """Measured tool point (3,), m."""
    goal: Vector
    """Target point (3,), m."""
    step: int
    """Policy steps since the episode began."""


class Policy(ABC):
    """Joint velocities from observations."""

    def begin(self) -> str:
        """Get ready for an episode. Returns why it must not take place; empty if it may."""
        return ""

    @abstractmethod
    def act(self, observation: Observation) -> Vector:
        """Return the wanted joint velocities (n,), rad/s."""
