"""Several arms, each on a bus of its own, as one arm: one supervisor stops them together.

A command leaves for all of them or for none: the guard sees the frames of all buses at once. When a bus is lost, its
joints keep their old stamps and the sample tells of a fault of the bus, so that the others are braked, and lowered
where they have no brakes. Only when the last bus is gone is there nothing left to supervise.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import Any

import can
import numpy as np

from robotctl.hal.arm import Arm, Gripper, Inspector
from robotctl.hal.can.bus_ids import tag
from robotctl.hal.can.channel import Channel, channel_names, open_channels
from robotctl.hal.can.damiao.arm import DamiaoArm
from robotctl.hal.can.tap import Tap
from robotctl.hal.clock import Clock
from robotctl.hal.errors import BusError, ConfigError, HardwareError
from robotctl.hal.robot import Robot
from robotctl.hal.types import Command, Fault, GripperSample, Sample, Sent, Truth

_REMEDY = "check the adapter, then connect again"
_GONE = 0x80
"""Code of the fault. No controller reports it: there is none any more."""
_COUNTERS = ("sent", "received", "error_frames", "unexpected", "rejected", "withheld", "send_failures")


class JoinedArm(Arm):
    """Fulfils `Arm` with one arm per bus, whose joints may stand in any order in the profile.

    `arms` and `lost` go by bus; `lost` says why a bus is gone, "" while it is there.
    """

    def __init__(self, robot: Robot, clock: Clock, channel: str) -> None:
        """Prepare. Opens and sends nothing.

        Args:
            robot: its drives say which bus they are on.
            clock: of all arms.
            channel: as many channels as buses, with commas between them; or one that opens them all.

        Raises:
            ConfigError: if their numbers differ, or the profile asks for what the wire cannot carry.
        """
        buses = range(robot.profile.buses)
        self._robot = robot
        self._clock = clock
        self._name = channel
        self._names = channel_names(channel, robot)
        self.arms = [DamiaoArm(robot.on_bus(bus), clock, self._names[bus]) for bus in buses]
        self.lost = [""] * len(self.arms)
        drives = [joint.drive for joint in robot.profile.joints]
        self._axes = [np.array([i for i, drive in enumerate(drives) if drive and drive.bus == bus]) for bus in buses]
        self._order = np.argsort(np.concatenate(self._axes))
        """Where in the arms' joints, one bus after the other, the profile's joints are."""
        self._gates: list[_Gate] = []
        self._inspector: Inspector | None = None
        self._taps: list[_BusTap] = []
        self._samples: list[Sample | None] = [None] * len(self.arms)
        self._enabled = False
        grippers = [(bus, arm.gripper) for bus, arm in enumerate(self.arms) if arm.gripper]
        self.gripper = _Gripper(grippers[0][1], self, grippers[0][0]) if grippers else None

    def inspect_with(self, inspector: Inspector) -> None:
        self._inspector = inspector
        self._gates = [_Gate(inspector, bus) for bus in range(len(self.arms))]
        for arm, gate in zip(self.arms, self._gates, strict=True):
            arm.inspect_with(gate)

    def record_frames(self, tap: Tap) -> None:
        self._taps = [_BusTap(tap, bus) for bus in range(len(self.arms))]
        for arm, part in zip(self.arms, self._taps, strict=True):
            arm.record_frames(part)

    @property
    def channel(self) -> Channel | None:
        """The open channel of the first bus; None before `connect` and after `close`."""
        return self.arms[0].channel

    @property
    def channels(self) -> list[Channel]:
        """The open channels, by bus; none before `connect` and after `close`."""
        return [arm.channel for arm in self.arms if arm.channel is not None]

    # --- life -------------------------------------------------------------------------------------------------------

    def connect(self) -> None:
        if self.channel is not None:
            return
        self.lost = [""] * len(self.arms)
        channels = open_channels(self._name, self._robot, self._clock)
        try:
            for arm, channel in zip(self.arms, channels, strict=True):
                arm.connect_to(channel)
        except ConfigError:
            self.close()
            for channel in channels:
                channel.close()
            raise

    def verify(self) -> None:
        """Read back every drive of every arm. Raises as `DamiaoArm.verify` does, with what all arms lack."""
        self._for_each(DamiaoArm.verify)
        if self._taps:
            self._taps[0].tap.describe(_joined([part.description for part in self._taps], self._order))

    def enable(self) -> None:
        """Enable every arm, each holding the measured pose; if one does not come on, none stays on."""
        try:
            for count, arm in enumerate(self.arms):
                arm.enable()
                for other in self.arms[:count]:  # whose watchdogs ran meanwhile
                    other.hold()
        except HardwareError:
            self.disable()
            raise
        self._enabled = True

    def take_over(self, command: Command) -> None:
        """Take the drives of every arm that can be reached; see `Arm.take_over`.

        Raises:
            HardwareError: if none can be.
        """
        errors = []
        for bus, (arm, part) in enumerate(zip(self.arms, self._parts(command), strict=True)):
            try:
                arm.take_over(part)
            except HardwareError as error:
                self.lost[bus] = str(error)
                errors.append(error)
        if len(errors) == len(self.arms):
            raise errors[0]
        self._enabled = True

    def read(self) -> Sample:
        for bus, arm in enumerate(self.arms):
            self.attempt(bus, partial(self._read, bus, arm))
        samples = [sample for sample in self._samples if sample is not None]
        if len(samples) < len(self.arms):
            raise BusError(next(filter(None, self.lost)), _REMEDY)
        order = self._order
        here = [sample for sample, why in zip(samples, self.lost, strict=True) if not why]
        faults = tuple(fault for sample in here for fault in sample.faults)
        return Sample(
            self._clock.now_ns(),
            np.concatenate([sample.position for sample in samples])[order],
            np.concatenate([sample.velocity for sample in samples])[order],
            np.concatenate([sample.effort for sample in samples])[order],
            np.concatenate([sample.joint_stamp_ns for sample in samples])[order],
            faults + tuple(self._fault(bus) for bus, why in enumerate(self.lost) if why),
            all(sample.enabled for sample in here),
            np.concatenate([sample.temperature for sample in samples if sample.temperature is not None])[order],
            sum(sample.rejected for sample in samples),
            tuple(axis for axes, why in zip(self._axes, self.lost, strict=True) if why for axis in axes.tolist()),
        )

    def write(self, command: Command) -> Sent:
        """Send one frame per joint, on all buses or on none: a refusal keeps all of them back."""
        here = [bus for bus, why in enumerate(self.lost) if not why]
        if not here:
            raise BusError(self.lost[0], _REMEDY)
        try:
            parts = self._parts(command)
            if not self._enabled:
                return self._sent(command, [arm.write(part) for arm, part in zip(self.arms, parts, strict=True)])
            cycles = {bus: self.arms[bus].encode(parts[bus]) for bus in here}
        except (ValueError, OverflowError):
            text = "not sent: a value is not finite, or there are not as many as joints"
            return Sent(command, text, delivered=False)
        if self._inspector is not None:
            refusal = self._inspector.frames(
                [(tag(bus, identifier), data) for bus, frames in cycles.items() for identifier, data in frames]
            )
            if refusal:
                return Sent(command, f"not sent: {refusal}", delivered=False)
            for bus, frames in cycles.items():
                self._gates[bus].judged = frames
        sent: list[Sent] = []
        for bus, frames in cycles.items():
            self.attempt(bus, partial(self._send, bus, parts[bus], frames, sent))
        return self._sent(command, sent)

    def hold(self) -> Sent:
        return self.write(self._whole([arm.holding() for arm in self.arms]))

    def disable(self) -> None:
        """Take the torque away from every drive of every arm; what one arm lacks does not keep the others from it."""
        self._enabled = False
        self._for_each(DamiaoArm.disable)

    def clear_faults(self) -> None:
        self._for_each(DamiaoArm.clear_faults)

    def close(self) -> None:
        """Close every arm; that frames of one wait and cannot be taken back does not keep the others open."""
        self._enabled = False
        self._samples = [None] * len(self.arms)
        self._for_each(DamiaoArm.close)

    # --- about ------------------------------------------------------------------------------------------------------

    def truth(self) -> Truth | None:
        return self.arms[0].truth()  # the plant behind one bus is that behind all

    def bus_statistics(self) -> dict[str, object] | None:
        """Return the sums over all buses, and in `buses` what each counts by itself."""
        found = [statistics for arm in self.arms if (statistics := arm.bus_statistics()) is not None]
        if not found:
            return None
        missed: dict[str, int] = {}
        for each in found:
            missed.update(each["missed_by_joint"])  # type: ignore[call-overload]
        return {
            **{key: sum(each[key] for each in found) for key in _COUNTERS},  # type: ignore[misc]
            "load": max(each["load"] for each in found),  # type: ignore[type-var]
            "missed_replies": sum(missed.values()),
            "missed_by_joint": missed,
            "buses": found,
        }

    # --- inside -----------------------------------------------------------------------------------------------------

    def attempt(self, bus: int, action: Callable[[], object]) -> None:
        """Do something on a bus that is there.

        Raises:
            BusError: if that was the last one.
        """
        if self.lost[bus]:
            if all(self.lost):
                raise BusError(self.lost[bus], _REMEDY)
            return
        try:
            action()
        except BusError as error:
            self.lost[bus] = error.what
            if all(self.lost):
                raise

    def _read(self, bus: int, arm: DamiaoArm) -> None:
        self._samples[bus] = arm.read()

    def _send(self, bus: int, part: Command, frames: Sequence[tuple[int, bytes]], sent: list[Sent]) -> None:
        sent.append(self.arms[bus].send(part, frames))

    def _fault(self, bus: int) -> Fault:
        hint = f"{self._names[bus]}: {self.lost[bus]}; check adapter and cable, connect again"
        return Fault("bus", _GONE, "GONE", hint)

    def _parts(self, command: Command) -> list[Command]:
        mode, position, velocity, effort = command
        if not len(position) == len(velocity) == len(effort) == len(self._order):
            raise ValueError("not as many values as joints")
        return [Command(mode, position[axes], velocity[axes], effort[axes]) for axes in self._axes]

    def _whole(self, parts: Sequence[Command]) -> Command:
        order = self._order
        joined = [np.concatenate([part[field] for part in parts])[order] for field in (1, 2, 3)]
        return Command(parts[0].mode, *joined)

    def _sent(self, command: Command, sent: Sequence[Sent]) -> Sent:
        delivered = len(sent) == len(self.arms) and all(each.delivered for each in sent)
        altered = "; ".join(dict.fromkeys(each.altered for each in sent if each.altered))
        if len(sent) < len(self.arms):
            altered = "; ".join(filter(None, [altered, *(f"not sent: {why}" for why in self.lost if why)]))
        elif altered:
            command = self._whole([each.command for each in sent])
        return Sent(command, altered, delivered)

    def _for_each(self, action: Callable[[DamiaoArm], None]) -> None:
        errors = []
        for arm in self.arms:
            try:
                action(arm)
            except HardwareError as error:
                errors.append(error)
        if len(errors) == 1:
            raise errors[0]
        if errors:
            raise HardwareError("\n".join(map(str, errors)))


class _Gate:
    """An `Inspector` of one bus: what the whole robot's has passed already is not judged twice."""

    def __init__(self, inspector: Inspector, bus: int) -> None:
        self.judged: Sequence[tuple[int, bytes]] | None = None
        self._inspector = inspector
        self._bus = bus

    def frames(self, frames: Sequence[tuple[int, bytes]]) -> str:
        judged, self.judged = self.judged, None
        if frames is judged:
            return ""
        return self._inspector.frames([(tag(self._bus, identifier), data) for identifier, data in frames])

    def command(self, command: Command) -> str:
        return self._inspector.command(command)

    def enabling(self) -> str:
        return self._inspector.enabling()


class _BusTap:
    """A `Tap` of one bus, which shows its frames to that of the robot."""

    def __init__(self, whole: Tap, bus: int) -> None:
        self.tap = whole
        self.description: Mapping[str, Any] = {}
        self._bus = bus

    def sent(self, frames: Sequence[tuple[int, bytes]], fd: bool, stamp_ns: int) -> None:
        self.tap.sent([(tag(self._bus, identifier), data) for identifier, data in frames], fd, stamp_ns)

    def received(self, frame: can.Message, stamp_ns: int) -> None:
        identifier = frame.arbitration_id
        frame.arbitration_id = tag(self._bus, identifier)
        self.tap.received(frame, stamp_ns)
        frame.arbitration_id = identifier

    def describe(self, description: Mapping[str, Any]) -> None:
        drives = [
            {**drive, "id": tag(self._bus, drive["id"]), "reply_id": tag(self._bus, drive["reply_id"])}
            for drive in description["drives"]
        ]
        self.description = {**description, "drives": drives}


class _Gripper(Gripper):
    """The gripper of one of the arms: when its bus is lost it is still, and the other arms go on."""

    def __init__(self, gripper: Gripper, arm: JoinedArm, bus: int) -> None:
        self._gripper = gripper
        self._arm = arm
        self._bus = bus

    def command(self, width: float, force: float) -> None:
        self._gripper.command(width, force)

    def read(self) -> GripperSample:
        return self._gripper.read()

    def step(self) -> None:
        self._arm.attempt(self._bus, self._gripper.step)


def _joined(descriptions: Sequence[Mapping[str, Any]], order: Iterable[int]) -> dict[str, Any]:
    """Return one description of the drives of all buses: joints in the profile's order, then the rest."""
    joints = [drive for each in descriptions for drive in each["drives"][: each["joints"]]]
    others = [drive for each in descriptions for drive in each["drives"][each["joints"] :]]
    return {**descriptions[0], "joints": len(joints), "drives": [joints[index] for index in order] + others}
