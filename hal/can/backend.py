"""The CAN backend: an arm, and its gripper, on drives behind a CAN channel."""

from robotctl.hal.backend import Rig
from robotctl.hal.can.damiao.arm import DamiaoArm
from robotctl.hal.can.joined import JoinedArm
from robotctl.hal.clock import Clock
from robotctl.hal.robot import Robot

DEFAULT_CHANNEL = "emulated"


def open_can(robot: Robot, clock: Clock, channel: str = "") -> Rig:
    """Return a robot on CAN. Entry point `can` of the group `robotctl.backends`. Opens nothing before `connect`.

    The channel is `emulated` (the default), `virtual:NAME`, `socketcan:can0`, `slcan:DEVICE`, or any other name that
    `open_channel` knows; for a robot on several buses, one for each, with commas between them.

    Raises:
        ConfigError: if the profile describes no CAN drives, or such that the wire cannot carry.
    """
    channel = channel or DEFAULT_CHANNEL
    if robot.profile.buses > 1:
        joined = JoinedArm(robot, clock, channel)
        return Rig(joined, joined.gripper)
    arm = DamiaoArm(robot, clock, channel)
    return Rig(arm, arm.gripper)
