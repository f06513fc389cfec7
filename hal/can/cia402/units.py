"""Joint radians and newton metres, and what they are on the wire of a CiA 402 drive.

Positions are increments of the motor's encoder, velocities increments per second (0x60A9 = 0x00B50300), torques
thousandths of the motor's rated torque.
"""

import math
from typing import NamedTuple

from robotctl.hal.profile import Cia402Drive, Joint

I16 = 0x7FFF
I32 = 0x7FFFFFFF


class Units(NamedTuple):
    """The map of one joint."""

    counts: float
    """Increments per joint radian, signed."""
    permille: float
    """Thousandths of the rated torque per joint newton metre, signed."""
    offset: float
    """Joint angle at the encoder's zero, rad."""

    @staticmethod
    def of(drive: Cia402Drive) -> "Units":
        scale = drive.sign * drive.gear
        return Units(scale * drive.resolution / (2.0 * math.pi), 1000.0 / (drive.rated_torque * scale), drive.offset)


def misfits(joint: Joint, drive: Cia402Drive) -> list[str]:
    """Return what a profile asks of a joint that its drive's numbers cannot hold."""
    counts, permille, offset = Units.of(drive)
    problems = []
    if max(abs(bound - offset) for bound in joint.position) * abs(counts) > I32:
        problems.append(f"{joint.name}: its range does not fit the 32 bits of a position at {drive.resolution} a turn")
    if joint.velocity * abs(counts) > I32:
        problems.append(f"{joint.name}: velocity {joint.velocity} does not fit the 32 bits of a speed")
    if joint.torque * abs(permille) > I16:
        largest = I16 / abs(permille)
        problems.append(f"{joint.name}: torque {joint.torque} exceeds what the wire can say, {largest:.1f}")
    return problems
