"""Errors that carry what went wrong, where, and what to try.

The command line turns them into exit statuses: `ConfigError` into 2, `HardwareError` into 4.
"""


class RobotctlError(Exception):
    """Base of all errors of this package.

    `remedy` says what a person can do; the text of the exception includes it.
    """

    def __init__(self, what: str, remedy: str = "") -> None:
        super().__init__(f"{what}\n  try: {remedy}" if remedy else what)
        self.what = what
        self.remedy = remedy


class ConfigError(RobotctlError):
    """A profile, task or argument that cannot be used."""


class HardwareError(RobotctlError):
    """A bus, drive or plant that is absent, silent or not as the profile says."""


class BusError(HardwareError):
    """A CAN channel that cannot be opened, or that was lost."""


class DriveError(HardwareError):
    """A drive that does not answer, or is not what the profile says.

    `joint` is the joint's name, `motor_id` its CAN id.
    """

    def __init__(self, joint: str, motor_id: int, what: str, remedy: str = "") -> None:
        super().__init__(f"{joint} (motor id 0x{motor_id:02X}): {what}", remedy)
        self.joint = joint
        self.motor_id = motor_id
