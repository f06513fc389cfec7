"""Taking the torque from an arm without brakes: it is damped with its gravity compensated, less and less of it."""

import numpy as np

from robotctl.control.kinematics import Kinematics
from robotctl.hal.types import Command, CommandMode, Vector

LOWERING_S = 2.0
"""Time over which gravity compensation fades before the drives go off."""


def gravity_share(began_ns: int, now_ns: int) -> float:
    """Return the share of gravity to compensate while an arm is lowered; 0 and less once it is down."""
    return 1.0 - (now_ns - began_ns) / (LOWERING_S * 1e9)


def damp(kinematics: Kinematics, position: Vector, share: float) -> Command:
    """Return the command that damps the joints at `position` (n,), rad, with a share of their gravity compensated."""
    return Command(CommandMode.DAMP, position, np.zeros_like(position), share * kinematics.gravity(position))
