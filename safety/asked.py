"""What messages to the drives ask for, as the guard reads them."""

from enum import Enum, auto
from typing import NamedTuple

from robotctl.safety.trip import Protection


class Kind(Enum):
    """Kinds of message."""

    READ = auto()
    """Feedback or a register."""
    MODE = auto()
    """The control mode, in RAM."""
    ENABLE = auto()
    DISABLE = auto()
    CLEAR = auto()
    """A drive's fault."""
    ZERO = auto()
    """The present angle becomes the zero."""
    STORE = auto()
    """Any other register, or flash."""
    TRACK = auto()
    """Position and velocity, with gains."""
    TORQUE = auto()
    DAMP = auto()
    GRIP = auto()


class Asked(NamedTuple):
    """A motion of one joint, in its own coordinates."""

    position: float
    """rad"""
    velocity: float
    """rad/s"""
    kp: float
    """Nm/rad"""
    kd: float
    """Nms/rad"""
    effort: float
    """Nm"""

    @property
    def kind(self) -> Kind:
        if self.kp:
            return Kind.TRACK
        return Kind.DAMP if self.kd else Kind.TORQUE


EXACT = Asked(0.0, 0.0, 0.0, 0.0, 0.0)
"""As a resolution: nothing was rounded."""


class Refusal(NamedTuple):
    """What was refused, and on whose account."""

    protection: Protection
    text: str
