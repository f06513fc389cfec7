"""The CAN backend: an arm, and its gripper, on drives behind a CAN channel."""

from robotctl.hal.arm import Gripper
from robotctl.hal.backend import Rig
from robotctl.hal.can.cia402.arm import Cia402Arm
from robotctl.hal.can.damiao.arm import DamiaoArm
from robotctl.hal.can.joined import JoinedArm
from robotctl.hal.clock import Clock
from robotctl.hal.errors import ConfigError
from robotctl.hal.profile import Cia402Drive
from robotctl.hal.robot import Robot

DEFAULT_CHANNEL = "emulated"


def open_can(robot: Robot, clock: Clock, channel: str = "") -> Rig:
    """Return a robot on CAN. Entry point `can` of the group `robotctl.backends`. Opens nothing before `connect`.

    The channel is `emulated` (the default), `virtual:NAME`, `socketcan:can0`, `slcan:DEVICE`, or any other name that
    `open_channel` knows; for a robot on several buses, one for each, with commas between them.

    Raises:
        ConfigError: if the profile describes no CAN drives, or such that the wire cannot carry.
    """
    profile, channel = robot.profile, channel or DEFAULT_CHANNEL
    canopen = [isinstance(joint.drive, Cia402Drive) for joint in profile.joints]
    if any(canopen) and not all(canopen):
        raise ConfigError(f"{robot.source}: joints of one arm on different protocols", "use one for all joints")
    if profile.gripper and isinstance(profile.gripper.drive, Cia402Drive):
        raise ConfigError(f"{robot.source}: no gripper on a CiA 402 drive is known", "use a DAMIAO drive, or none")
    if any(canopen) and profile.buses > 1:
        raise ConfigError(
            f"{robot.source}: CiA 402 drives on a robot with {profile.buses} buses, which only DAMIAO drives may have",
            "put all drives on one bus: `bus: 0`",
        )
    arm: Cia402Arm | DamiaoArm | JoinedArm
    if profile.buses > 1:
        arm = JoinedArm(robot, clock, channel)
    else:
        arm = (Cia402Arm if any(canopen) else DamiaoArm)(robot, clock, channel)
    gripper: Gripper | None = arm.gripper
    return Rig(arm, gripper)
