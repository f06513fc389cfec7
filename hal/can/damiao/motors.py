"""Full-scale ranges of DAMIAO motors.

They are a fallback for what a profile expects, never the truth: bring-up reads PMAX, VMAX and TMAX (registers 21
to 23) from each drive and refuses a mismatch, since published tables disagree. The DM4340 is the standing example:
older tables say 8 rad/s, which makes every velocity wrong by a factor of exactly 0.8.
"""

from typing import NamedTuple


class Ranges(NamedTuple):
    """Full scale of the position, velocity and torque fields of a drive's frames."""

    pmax: float
    """rad"""
    vmax: float
    """rad/s"""
    tmax: float
    """Nm"""


MOTORS: dict[str, Ranges] = {
    "DM3507": Ranges(12.5, 50.0, 5.0),
    "DM4310": Ranges(12.5, 30.0, 10.0),
    "DM4340": Ranges(12.5, 10.0, 28.0),
    "DM6006": Ranges(12.5, 45.0, 20.0),
    "DM8006": Ranges(12.5, 45.0, 40.0),
    "DM8009": Ranges(12.5, 45.0, 54.0),
    "DM6248P": Ranges(12.566, 20.0, 120.0),
    "DM10010L": Ranges(12.5, 25.0, 200.0),
    "DM10010": Ranges(12.5, 20.0, 200.0),
    "DMH3510": Ranges(12.5, 280.0, 1.0),
    "DMH6215": Ranges(12.5, 45.0, 10.0),
    "DMG6220": Ranges(12.5, 45.0, 10.0),
}
"""Sources: openarm_can, python-damiao-driver and i2rt driver tables as of September 2026, cross-checked."""
