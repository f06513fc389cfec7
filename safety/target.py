"""What a policy may ask for: a closed set of targets, as data.

Each target names the epoch it was made in, its place in the policy's sequence, and when it expires. A stop raises
the epoch, so that nothing queued before it can run after it.
"""

from typing import NamedTuple

from robotctl.hal.types import Vector


class JointVelocity(NamedTuple):
    """Move the joints at `values`, rad/s, shape (n,)."""

    values: Vector
    epoch: int
    seq: int
    deadline_ns: int


class JointTorque(NamedTuple):
    """Apply `values` on top of gravity compensation, Nm, shape (n,)."""

    values: Vector
    epoch: int
    seq: int
    deadline_ns: int


class Hold(NamedTuple):
    """Stay where you are."""

    epoch: int
    seq: int
    deadline_ns: int


class FreeDrive(NamedTuple):
    """Compensate gravity, and let a person lead the arm."""

    epoch: int
    seq: int
    deadline_ns: int


Target = JointVelocity | JointTorque | Hold | FreeDrive
