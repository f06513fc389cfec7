"""What messages to the drives ask for, as the guard reads them."""

from collections.abc import Iterator, Sequence
from enum import Enum, auto
from typing import NamedTuple, Protocol

from robotctl.hal.can.bus_ids import untag
from robotctl.safety.trip import Protection


class Kind(Enum):
    """Kinds of message."""

    READ = auto()
    """Feedback or a register, and that the host is there."""
    MODE = auto()
    """The control mode, in RAM; how frames are laid out."""
    START = auto()
    """A drive is to take part in what goes on, without torque."""
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


class Move(NamedTuple):
    """A motion that a message asks for."""

    joint: int
    """Its index."""
    asked: Asked
    step: Step
    """What rounding may have cost it."""


class Reading(Protocol):
    """Reads the frames of a protocol."""

    def read(
        self, frames: Sequence[tuple[int, bytes]], measured: Sequence[tuple[float, float]]
    ) -> Iterator[Kind | Move | str]:
        """Return what frames (id, data) that leave together ask for; a text for one that is not on the list.

        Args:
            frames: all of them, in their order.
            measured: position, rad, and velocity, rad/s, of each joint.
        """
        ...


def stranger(arbitration_id: int, data: bytes) -> str:
    """Return why a frame may not leave that no reading knows."""
    bus, wire_id = untag(arbitration_id)
    return f"frame {wire_id:03X}#{data.hex()} is not on the list of this arm" + (f", bus {bus}" if bus else "")


class Refusal(NamedTuple):
    """What was refused, and on whose account."""

    protection: Protection
    text: str
