"""What every arm on a CAN bus has, whatever its drives speak: a channel, a transport, and who inspects what leaves."""

from abc import abstractmethod
from collections.abc import Sequence
from typing import Protocol

import numpy as np

from robotctl.hal.arm import Arm, Inspector
from robotctl.hal.can.bandwidth import require_bandwidth
from robotctl.hal.can.channel import Channel, is_shared, open_channel, reopen_channel
from robotctl.hal.can.problems import DrivesError
from robotctl.hal.can.tap import Tap
from robotctl.hal.can.transport import Transport
from robotctl.hal.clock import Clock, VirtualClock
from robotctl.hal.errors import ConfigError, DriveError, HardwareError
from robotctl.hal.robot import Robot
from robotctl.hal.types import Command, CommandMode, Fault, Sample, Sent, Truth, Vector, frozen

_BUS_FAULTS = {
    "bus-off": Fault(
        "bus", 0x40, "BUS_OFF", "the controller left the bus after too many errors; check cable and termination"
    ),
    "passive": Fault(
        "bus", 0x20, "ERROR_PASSIVE", "the controller sees too many errors; check cable, termination and bit rates"
    ),
}
"""What the states of a controller in trouble mean to a person."""


class MeasuringDrive(Protocol):
    """A drive of a joint, as far as every protocol's is alike."""

    name: str
    missed: int
    position: float
    """rad, as velocity and effort are the joint's, too."""
    velocity: float
    effort: float
    stamp_ns: int


class DrivenGripper(Protocol):
    """A gripper whose drive goes off with those of the arm."""

    def release(self) -> None:
        """Forget what it was told: its drive is off, or will be."""
        ...


def _bus_faults(transport: Transport) -> tuple[Fault, ...]:
    """Return what the controller suffers from."""
    return (_BUS_FAULTS[transport.state],) if transport.state in _BUS_FAULTS else ()


class CanArm(Arm):
    """Opens its channel in `connect` and not before. `warnings` holds what bring-up put right."""

    gripper: DrivenGripper | None
    _joints: Sequence[MeasuringDrive]
    """The drives of the joints; none before `_attach`."""

    def __init__(self, robot: Robot, clock: Clock, channel: str) -> None:
        """Prepare. Opens and sends nothing.

        Raises:
            ConfigError: if the profile has no CAN drives.
        """
        if robot.profile.can is None:
            raise ConfigError(
                f"{robot.source}: the robot has no `can` section", "use --backend sim, or describe its drives"
            )
        self.warnings: list[str] = []
        self._inspector: Inspector | None = None
        self._tap: Tap | None = None
        self._robot = robot
        self._clock = clock
        self._name = channel
        self._can = robot.profile.can
        self._channel: Channel | None = None
        self._transport: Transport | None = None
        self._verified = False
        self._enabled = False
        self._zeros = frozen([0.0] * robot.dof)
        self._still = [0.0] * robot.dof
        self._feed_forward: Vector = self._zeros
        """Effort of the latest command: what a hold goes on with (n,), Nm."""
        self._polled_ns = 0
        """When drives that are off were last asked how they are."""

    @property
    def channel(self) -> Channel | None:
        """The open channel; None before `connect` and after `close`."""
        return self._channel

    def inspect_with(self, inspector: Inspector) -> None:
        self._inspector = inspector
        if self._transport is not None:
            self._transport.inspector = inspector.frames

    def record_frames(self, tap: Tap) -> None:
        self._tap = tap
        if self._transport is not None:
            self._transport.tap = tap

    def connect(self) -> None:
        if not self._open:
            self.connect_to(open_channel(self._name, self._robot, self._clock))

    def connect_to(self, channel: Channel) -> None:
        """As `connect`, on a channel that is open already.

        Raises:
            ConfigError: as `connect` does; the channel is shut down then.
        """
        if isinstance(self._clock, VirtualClock) and not channel.simulated:
            channel.bus.shutdown()
            raise ConfigError(
                f"the drives behind {self._name!r} live in real time, which lockstep outruns: they would move too fast",
                "leave out --fast, or use --channel emulated",
            )
        profile = self._robot.profile
        try:
            require_bandwidth(self._name, profile.drives, profile.servo_hz, self._can, channel.fd)
        except ConfigError:
            channel.bus.shutdown()
            raise
        transport = Transport(channel, self._clock, self._can.bitrate, self._can.data_bitrate)
        if self._inspector is not None:
            transport.inspector = self._inspector.frames
        transport.tap = self._tap
        self._channel, self._transport = channel, transport
        self._verified = self._enabled = False
        self._attach(transport)

    def take_over(self, command: Command) -> None:
        """Take drives that another process had enabled; see `Arm.take_over`.

        Raises:
            HardwareError: on channels whose drives live in the process that opened them.
            BusError: if the channel cannot be opened.
        """
        if not is_shared(self._name):
            super().take_over(command)
        self.connect_to(reopen_channel(self._name, self._robot, self._clock))
        self._verified = self._enabled = True
        self._take_over(command)

    def hold(self) -> Sent:
        """Ask the drives to hold the measured pose, with the effort of the latest command as feed-forward.

        Raises:
            BusError: if the bus is gone.
        """
        return self.write(self.holding())

    def holding(self) -> Command:
        """Return what holds the measured pose, with the effort of the latest command as feed-forward."""
        position = np.array([drive.position for drive in self._joints])
        return Command(CommandMode.TRACK, position, self._zeros, self._feed_forward)

    def disable(self) -> None:
        """Take the torque away from every drive, the gripper's too. Resent up to ten times until confirmed.

        Raises:
            DriveError: if one drive never confirms; DrivesError if several do not.
            BusError: if the bus is gone.
        """
        self._enabled = False
        self._feed_forward = self._zeros
        if self.gripper:
            self.gripper.release()
        if not self._open:
            return
        try:
            self._switch_off()
        except (DriveError, DrivesError):
            self._verified = False
            self._require_open().purge()
            raise

    def close(self) -> None:
        if self.gripper:
            self.gripper.release()
        self._verified = self._enabled = False
        self._channel = None
        if self._transport is not None:
            try:
                self._transport.purge()
            finally:
                self._transport.close()

    def truth(self) -> Truth | None:
        channel = self._channel
        return channel.truth() if channel is not None and channel.truth is not None else None

    # --- for the arms of a protocol ---------------------------------------------------------------------------------

    @abstractmethod
    def _attach(self, transport: Transport) -> None:
        """Build the drives on a transport that was just opened. Send nothing."""

    @abstractmethod
    def _switch_off(self) -> None:
        """Take the torque away from every drive, confirmed."""

    @abstractmethod
    def _take_over(self, command: Command) -> None:
        """Send `command` to drives that are on, and learn where they are."""

    @property
    def _open(self) -> bool:
        return self._channel is not None

    def _require_open(self) -> Transport:
        if self._channel is None or self._transport is None:
            raise HardwareError("the arm is not connected", "call connect() first")
        return self._transport

    def _sample(self, now_ns: int, faults: tuple[Fault, ...], temperature: Vector | None, *, enabled: bool) -> Sample:
        """Return what the joints' drives told last, and what the bus suffers from."""
        joints, transport = self._joints, self._require_open()
        return Sample(
            now_ns,
            np.array([drive.position for drive in joints]),
            np.array([drive.velocity for drive in joints]),
            np.array([drive.effort for drive in joints]),
            np.array([drive.stamp_ns for drive in joints], dtype=np.int64),
            faults + _bus_faults(transport),
            enabled,
            temperature,
            transport.rejected,
        )

    def _count(self, drives: Sequence[MeasuringDrive]) -> dict[str, object] | None:
        """Return the counters since `connect`; they outlive `close`. `missed_by_joint` counts per drive."""
        if self._transport is None:
            return None
        missed = {drive.name: drive.missed for drive in drives}
        return {**self._transport.statistics(), "missed_replies": sum(missed.values()), "missed_by_joint": missed}
