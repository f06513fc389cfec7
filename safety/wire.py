"""Which reading of frames an arm takes: that of the protocols its drives speak."""

from robotctl.hal.profile import RobotProfile
from robotctl.safety.asked import Reading
from robotctl.safety.wire_402 import Wire402
from robotctl.safety.wire_guard import WireGuard


def reading_of(profile: RobotProfile) -> Reading:
    """Return what reads the frames to all drives of a profile, the gripper's among them."""
    damiao = WireGuard(profile)
    if profile.protocol == "cia402":
        return Wire402(profile, damiao)
    return damiao
