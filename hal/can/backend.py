"""The CAN backend: an arm, and its gripper, on drives behind a CAN channel."""

from robotctl.hal.backend import Rig
from robotctl.hal.can.damiao.arm import DamiaoArm
from robotctl.hal.clock import Clock
from robotctl.hal.robot import Robot

DEFAULT_CHANNEL = "emulated"


def open_can(robot: Robot, clock: Clock, channel: str = "") -> Rig:
    """Return a robot on CAN. Entry point `can` of the group `robotctl.backends`. Opens nothing before `connect`.

    The channel is `emulated` (the default), `virtual:NAME`, `socketcan:can0`, `slcan:DEVICE`, or any other name that
    `open_channel` knows.

    Raises:
        ConfigError: if the profile describes no CAN drives, or such that the wire cannot carry.
    """
    arm = DamiaoArm(robot, clock, channel or DEFAULT_CHANNEL)
    return Rig(arm, arm.gripper)
