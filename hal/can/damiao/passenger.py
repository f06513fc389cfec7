"""A gripper on a DAMIAO drive that rides on the bus of an arm whose drives speak something else."""

import numpy as np

from robotctl.hal.can.damiao.codec import Special, Status
from robotctl.hal.can.damiao.drive import CONFIRM_TIMEOUT_S, TRIES, Drive
from robotctl.hal.can.damiao.faults import fault_of, is_fault, status_name
from robotctl.hal.can.damiao.gripper import DamiaoGripper
from robotctl.hal.can.damiao.motors import MOTORS
from robotctl.hal.can.damiao.power import clear_faults, not_ready, switch_off
from robotctl.hal.can.damiao.registers import ControlMode
from robotctl.hal.can.damiao.verification import Eavesdropper, Expected, verify_drive
from robotctl.hal.can.transport import Transport
from robotctl.hal.clock import Clock
from robotctl.hal.errors import DriveError
from robotctl.hal.profile import DamiaoDrive, GripperProfile
from robotctl.hal.types import Fault


class Passenger:
    """The gripper with its drive. The arm that carries it calls these in its own calls of the same names."""

    def __init__(self, profile: GripperProfile, wiring: DamiaoDrive, timeout_s: float, clock: Clock) -> None:
        self.gripper = DamiaoGripper(profile, clock)
        self.drive: Drive | None = None
        self._wiring = wiring
        self._clock = clock
        self._expected = Expected(wiring.motor, ControlMode.POS_FORCE, timeout_s, None, 2.0 * np.pi)
        self._transport: Transport | None = None

    def attach(self, transport: Transport) -> None:
        """Use this transport from now on. Sends nothing."""
        wiring = self._wiring
        self._transport = transport
        self.drive = Drive(
            "gripper", wiring.id, wiring.reply_id, MOTORS[wiring.motor], transport, self._clock
        )  # motor_open maps its angle, so it stays in the motor's own radians
        self.gripper.attach(self.drive, transport)

    @property
    def commands(self) -> set[int]:
        """The ids of frames that tell the drive to do something."""
        return self._require().commands

    @property
    def is_on(self) -> bool:
        return self._require().status == Status.ENABLED

    def verify(self, warnings: list[str]) -> list[DriveError]:
        """Read the drive back, and return everything that is wrong with it."""
        drive = self._require()
        others = Eavesdropper()
        assert self._transport is not None
        self._transport.listener = others
        try:
            return verify_drive(drive, self._expected, others, warnings)[1]
        finally:
            self._transport.listener = None

    def not_ready(self) -> list[DriveError]:
        return not_ready([self._require()], [self._expected])

    def enable(self) -> None:
        """Enable the drive, holding the measured opening.

        Raises:
            DriveError: if it does not come on.
        """
        drive = self._require()
        for _ in range(TRIES):
            if drive.answers(Special.ENABLE) and drive.status == Status.ENABLED:
                self.gripper.engage()
                return
        name = status_name(drive.status)
        raise drive.error(f"did not enable in {TRIES} tries, its status is {name}", "check its supply")

    def take_over(self) -> None:
        """Go on with a drive that another process had enabled, if it answers."""
        assert self._transport is not None
        drive = self._require()
        if self._transport.wait(lambda: bool(drive.heard), CONFIRM_TIMEOUT_S):
            self.gripper.engage()

    def disable(self) -> None:
        """Take the torque away.

        Raises:
            DriveError: if the drive never confirms.
        """
        assert self._transport is not None
        switch_off([self._require()], self._transport)

    def clear(self) -> None:
        clear_faults([self._require()])

    def poll(self) -> None:
        """Ask for feedback without waiting."""
        drive = self._require()
        drive.expect_reply(self._clock.now_ns())
        drive.reply_pending = drive.poll()

    def faults(self) -> tuple[Fault, ...]:
        drive = self._require()
        return (fault_of(drive.name, drive.status),) if is_fault(drive.status) else ()

    def _require(self) -> Drive:
        assert self.drive is not None
        return self.drive
