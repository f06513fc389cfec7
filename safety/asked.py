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

    kind: Kind
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

    @staticmethod
    def of(position: float, velocity: float, kp: float, kd: float, effort: float) -> "Asked":
        """Return the motion whose kind its gains tell."""
        kind = Kind.TRACK if kp else Kind.DAMP if kd else Kind.TORQUE
        return Asked(kind, position, velocity, kp, kd, effort)


class Step(NamedTuple):
    """How far off each field of a motion may be for rounding, in the same units."""

    position: float
    velocity: float
    kp: float
    kd: float
    effort: float


EXACT = Step(0.0, 0.0, 0.0, 0.0, 0.0)


class Refusal(NamedTuple):
    """What was refused, and on whose account."""

    protection: Protection
    text: str
