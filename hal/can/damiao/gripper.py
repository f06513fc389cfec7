"""A gripper on a DAMIAO drive in POS_FORCE mode. The arm that shares its bus enables, holds and disables it.

The opening is linear in the motor's angle: `angle = motor_open * width / full width`. By virtual work a grip force F
takes the motor torque `F * full width / |motor_open|`; the frame carries it as a fraction of the largest current,
which is taken to give TMAX.
"""

from robotctl.hal.arm import Gripper
from robotctl.hal.can.damiao.codec import Offset, PosForceCommand, encode_pos_force
from robotctl.hal.can.damiao.drive import Drive
from robotctl.hal.can.transport import Transport
from robotctl.hal.clock import Clock
from robotctl.hal.profile import GripperProfile
from robotctl.hal.types import GripperSample

PERIOD_NS = 10_000_000
"""Between two frames: a tenth of the longest drive watchdog allowed."""

_EARLY_NS = 500_000
"""A tick that comes early by less than this still counts; without it jitter would cost a whole servo period."""

_HOLD_FORCE = 0.25
"""Fraction of the largest force with which the fingers are held until the first command."""


class DamiaoGripper(Gripper):
    """Sends the latest command every 10 ms while engaged; its drive's watchdog lives on that."""

    def __init__(self, profile: GripperProfile, clock: Clock) -> None:
        self._profile = profile
        self._clock = clock
        self._drive: Drive | None = None
        self._transport: Transport | None = None
        self._engaged = False
        self._frame = b""
        self._due_ns = 0

    def attach(self, drive: Drive, transport: Transport) -> None:
        """Use this drive from now on. Sends nothing."""
        self._drive, self._transport, self._engaged = drive, transport, False

    def engage(self) -> None:
        """Start to hold the measured opening. The drive is enabled."""
        assert self._drive is not None
        self._frame = self._encode(self._drive.position, _HOLD_FORCE * self._profile.force)
        self._engaged = True
        self._due_ns = 0
        self.step()

    def release(self) -> None:
        """Send nothing any more; forgets the command, so that the next start holds what is measured then."""
        self._engaged = False

    def command(self, width: float, force: float) -> None:
        if not 0.0 <= width <= self._profile.width:
            raise ValueError(f"gripper width {width} m is outside 0..{self._profile.width}")
        if not 0.0 < force <= self._profile.force:
            raise ValueError(f"grip force {force} N is outside 0..{self._profile.force}")
        if self._engaged:
            self._frame = self._encode(self._profile.motor_open * width / self._profile.width, force)

    def read(self) -> GripperSample:
        drive, profile = self._drive, self._profile
        if drive is None:
            return GripperSample(0, float("nan"), float("nan"))
        width = profile.width * drive.position / profile.motor_open
        return GripperSample(drive.stamp_ns, width, abs(drive.effort) * self._newtons_per_nm)

    def step(self) -> None:
        """Send the command if it is due.

        Raises:
            BusError: if the bus is gone.
        """
        if not self._engaged or self._drive is None or self._transport is None:
            return
        now = self._clock.now_ns()
        if now < self._due_ns - _EARLY_NS:
            return
        self._due_ns = now + PERIOD_NS
        drive = self._drive
        drive.expect_reply(now)
        drive.reply_pending = self._transport.send(Offset.POS_FORCE + drive.id, self._frame, fd=self._transport.fd)
        if self._transport.simulated:
            self._transport.drain()

    @property
    def _newtons_per_nm(self) -> float:
        return abs(self._profile.motor_open) / self._profile.width

    def _encode(self, angle: float, force: float) -> bytes:
        assert self._drive is not None
        speed = self._profile.speed * self._newtons_per_nm
        current = force / self._newtons_per_nm / self._drive.ranges.tmax
        return encode_pos_force(PosForceCommand(angle, speed, min(current, 1.0)))
