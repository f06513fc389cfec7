"""What passes between the loop and an arm: samples up, commands down. SI units throughout.

Named tuples, since they are immutable and the cheapest record Python has: several are made in every tick.
"""

from enum import IntEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Vector = NDArray[np.float64]
"""One value per joint, shape (n,), or a point in the base frame, shape (3,)."""

Stamps = NDArray[np.int64]
"""Monotonic nanoseconds per joint, shape (n,)."""


class Fault(NamedTuple):
    """A fault that a drive reports of itself."""

    joint: str
    code: int
    """The drive's own code, as it stands on the wire."""
    name: str
    hint: str


class Sample(NamedTuple):
    """What the arm measured. Arrays are (n,), in the order of the profile's joints, and not to be written to."""

    stamp_ns: int
    """When it was read."""
    position: Vector
    """rad"""
    velocity: Vector
    """rad/s"""
    effort: Vector
    """Nm"""
    joint_stamp_ns: Stamps
    """When each joint was last heard of; the age of feedback is judged by this."""
    faults: tuple[Fault, ...] = ()
    enabled: bool = False
    """Whether every drive reported that it is enabled."""
    temperature: Vector | None = None
    """Hottest part of each drive, degrees Celsius; None where the drives do not tell."""
    rejected: int = 0
    """Frames refused since connecting: on a drive's id, but of a wrong length or not decodable."""
    cut_off: tuple[int, ...] = ()
    """Joints behind a bus that is gone while others are there; `enabled` and `faults` do not count them."""


class CommandMode(IntEnum):
    """Which law the drives are to follow."""

    TRACK = 1
    """Position and velocity tracking with the profile's gains, plus `effort` as feed-forward."""
    EFFORT = 2
    """`effort` alone."""
    DAMP = 3
    """Velocity damping with the profile's kd, plus `effort` (gravity)."""


class Command(NamedTuple):
    """What every joint is asked to do until the next command. Arrays are (n,)."""

    mode: CommandMode
    position: Vector
    """rad; used by TRACK"""
    velocity: Vector
    """rad/s; used by TRACK"""
    effort: Vector
    """Nm"""


class Sent(NamedTuple):
    """What `Arm.write` really sent, and why it differs from what was asked."""

    command: Command
    altered: str = ""
    """Empty when the command went out as it was (up to the drive's quantisation)."""
    delivered: bool = True
    """Whether it left the host, for every joint."""


class GripperSample(NamedTuple):
    """What the gripper measured."""

    stamp_ns: int
    width: float
    """Opening between the fingers, m."""
    force: float
    """Grip force, N."""


class Truth(NamedTuple):
    """The plant's true state, which only a simulation knows. The invariants are judged on it."""

    position: Vector
    velocity: Vector
    effort: Vector
    tool: Vector
    """Tool point in the base frame, shape (3,), m."""


def frozen(values: object) -> Vector:
    """Return `values` as a float64 array that refuses to be written to."""
    array = np.array(values, dtype=np.float64)
    array.flags.writeable = False
    return array
