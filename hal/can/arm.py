"""What every arm on a CAN bus has, whatever its drives speak: a channel, a transport, and who inspects what leaves."""

from abc import abstractmethod
from collections.abc import Sequence
from typing import Protocol

from robotctl.hal.arm import Arm, Inspector
from robotctl.hal.can.bandwidth import require_bandwidth
from robotctl.hal.can.channel import Channel, is_shared, open_channel, reopen_channel
from robotctl.hal.can.tap import Tap
from robotctl.hal.can.transport import Transport
from robotctl.hal.clock import Clock, VirtualClock
from robotctl.hal.errors import ConfigError, HardwareError
from robotctl.hal.robot import Robot
from robotctl.hal.types import Command, Fault, Truth

_BUS_FAULTS = {
    "bus-off": Fault(
        "bus", 0x40, "BUS_OFF", "the controller left the bus after too many errors; check cable and termination"
    ),
    "passive": Fault(
        "bus", 0x20, "ERROR_PASSIVE", "the controller sees too many errors; check cable, termination and bit rates"
    ),
}
"""What the states of a controller in trouble mean to a person."""


class Counted(Protocol):
    """A drive, as far as statistics go."""

    name: str
    missed: int


def bus_faults(transport: Transport) -> tuple[Fault, ...]:
    """Return what the controller suffers from."""
    return (_BUS_FAULTS[transport.state],) if transport.state in _BUS_FAULTS else ()


class CanArm(Arm):
    """Opens its channel in `connect` and not before. `warnings` holds what bring-up put right."""

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
            self._use(open_channel(self._name, self._robot, self._clock))

    def connect_to(self, channel: Channel) -> None:
        """As `connect`, on a channel that is open already.

        Raises:
            ConfigError: as `connect` does; the channel is shut down then.
        """
        self._use(channel)

    def take_over(self, command: Command) -> None:
        """Take drives that another process had enabled; see `Arm.take_over`.

        Raises:
            HardwareError: on channels whose drives live in the process that opened them.
            BusError: if the channel cannot be opened.
        """
        if not is_shared(self._name):
            super().take_over(command)
        self._use(reopen_channel(self._name, self._robot, self._clock))
        self._verified = self._enabled = True
        self._take_over(command)

    def close(self) -> None:
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
    def _take_over(self, command: Command) -> None:
        """Send `command` to drives that are on, and learn where they are."""

    @property
    def _open(self) -> bool:
        return self._channel is not None

    def _require_open(self) -> Transport:
        if self._channel is None or self._transport is None:
            raise HardwareError("the arm is not connected", "call connect() first")
        return self._transport

    def _count(self, drives: Sequence[Counted]) -> dict[str, object] | None:
        """Return the counters since `connect`; they outlive `close`. `missed_by_joint` counts per drive."""
        if self._transport is None:
            return None
        missed = {drive.name: drive.missed for drive in drives}
        return {**self._transport.statistics(), "missed_replies": sum(missed.values()), "missed_by_joint": missed}

    def _use(self, channel: Channel) -> None:
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
