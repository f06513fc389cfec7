"""Trouble to order on the twin: what goes wrong between a loop and its arm, wrapped round any `Arm`.

Emulated motors have trouble of their own (`sim/motors/trouble.py`), which goes wrong on the wire. What is wrong with
the plant itself, a seized joint or a push, needs neither: see `Plant.jam`, `Plant.push` and `Plant.place`.
"""

from collections.abc import Callable, Iterable
from math import inf

import numpy as np

from robotctl.hal.arm import Arm, Inspector
from robotctl.hal.errors import DriveError
from robotctl.hal.types import Command, CommandMode, Fault, Sample, Sent, Truth, Vector
from robotctl.sim.backend import SimArm


class Trouble:
    """Something that is wrong with an arm while it is in `TroubledArm.troubles`."""

    acted = 0
    """How often it changed something: the proof that it was there."""

    def on_read(self, sample: Sample) -> Sample:
        """Return what the loop gets to see."""
        return sample

    def on_write(self, command: Command) -> Command | Sent:
        """Return what reaches the arm, or what the loop is told where nothing does."""
        return command

    def on_verify(self) -> None:
        """Raise what the self-test is to find."""

    def on_plant(self) -> None:
        """Act on what moves the arm, whenever something was read or written."""


class TroubledArm(Arm):
    """An arm, and the troubles it is in. Without any it is the arm it wraps."""

    def __init__(self, arm: Arm) -> None:
        self.arm = arm
        self.troubles: list[Trouble] = []
        self.seen: Sample | None = None
        """The latest sample that the loop got to see."""

    def inspect_with(self, inspector: Inspector) -> None:
        self.arm.inspect_with(inspector)

    def connect(self) -> None:
        self.arm.connect()

    def verify(self) -> None:
        for trouble in self.troubles:
            trouble.on_verify()
        self.arm.verify()

    def enable(self) -> None:
        self.arm.enable()

    def read(self) -> Sample:
        sample = self.arm.read()
        for trouble in self.troubles:
            trouble.on_plant()
            sample = trouble.on_read(sample)
        self.seen = sample
        return sample

    def write(self, command: Command) -> Sent:
        for trouble in self.troubles:
            altered = trouble.on_write(command)
            if isinstance(altered, Sent):
                return altered
            command = altered
        sent = self.arm.write(command)
        for trouble in self.troubles:
            trouble.on_plant()
        return sent

    def hold(self) -> Sent:
        return self.arm.hold()

    def disable(self) -> None:
        self.arm.disable()

    def clear_faults(self) -> None:
        self.arm.clear_faults()

    def close(self) -> None:
        self.arm.close()

    def take_over(self, command: Command) -> None:
        self.arm.take_over(command)

    def truth(self) -> Truth | None:
        return self.arm.truth()

    def bus_statistics(self) -> dict[str, object] | None:
        return self.arm.bus_statistics()


# -- what the loop gets to see ----------------------------------------------------------------------------------------


class Mute(Trouble):
    """Some joints are not heard of: they stay what they were in the last sample, and their stamps grow old."""

    def __init__(self, axes: Iterable[int], last: Sample) -> None:
        self._axes = list(axes)
        self._last = last

    def on_read(self, sample: Sample) -> Sample:
        self.acted += 1
        fields = ("position", "velocity", "effort", "joint_stamp_ns")
        mixed = {field: getattr(sample, field).copy() for field in fields}
        for field, values in mixed.items():
            values[self._axes] = getattr(self._last, field)[self._axes]
        return sample._replace(**mixed)


class Misread(Trouble):
    """Something is added to what is measured; NaN makes it no number."""

    def __init__(self, position: Vector | float = 0.0, velocity: Vector | float = 0.0) -> None:
        """Take what is added, (n,) or the same for all, rad and rad/s."""
        self._position = position
        self._velocity = velocity

    def on_read(self, sample: Sample) -> Sample:
        self.acted += 1
        return sample._replace(position=sample.position + self._position, velocity=sample.velocity + self._velocity)


class Frozen(Trouble):
    """Some joints are measured at rest where they were in the last sample, however they move: a stuck encoder."""

    def __init__(self, axes: Iterable[int], last: Sample) -> None:
        self._axes = list(axes)
        self._last = last

    def on_read(self, sample: Sample) -> Sample:
        self.acted += 1
        position, velocity = sample.position.copy(), sample.velocity.copy()
        position[self._axes], velocity[self._axes] = self._last.position[self._axes], 0.0
        return sample._replace(position=position, velocity=velocity)


class Heat(Trouble):
    """Some drives report a temperature, degrees Celsius."""

    def __init__(self, axes: Iterable[int], temperature: float) -> None:
        self._axes = list(axes)
        self._reported = temperature

    def on_read(self, sample: Sample) -> Sample:
        self.acted += 1
        before = sample.temperature
        temperature = np.full(len(sample.position), 25.0) if before is None else before.copy()
        temperature[self._axes] = self._reported
        return sample._replace(temperature=temperature)


class Reject(Trouble):
    """In every reading some frames come that make no sense."""

    def __init__(self, frames: int = 1) -> None:
        self._frames = frames

    def on_read(self, sample: Sample) -> Sample:
        self.acted += 1
        return sample._replace(rejected=sample.rejected + self._frames * self.acted)


class Report(Trouble):
    """A fault is reported, of a drive or, with the joint `bus`, of the bus."""

    def __init__(self, fault: Fault) -> None:
        self._fault = fault

    def on_read(self, sample: Sample) -> Sample:
        self.acted += 1
        return sample._replace(faults=(*sample.faults, self._fault))


# -- what reaches the arm ---------------------------------------------------------------------------------------------


class Garble(Trouble):
    """Some commands are altered on their way to the arm, as by a bug of whatever made them."""

    def __init__(self, alter: Callable[[Command], Command], times: float = inf) -> None:
        self._alter = alter
        self._times = times

    def on_write(self, command: Command) -> Command | Sent:
        if self.acted >= self._times:
            return command
        self.acted += 1
        return self._alter(command)


class NoWatchdog(Trouble):
    """A drive reports that it has no watchdog, in the words of a real one."""

    def __init__(self, joint: str) -> None:
        self._joint = joint

    def on_verify(self) -> None:
        self.acted += 1
        raise DriveError(self._joint, 1, "has no watchdog", "give it one")


# -- what moves the arm -----------------------------------------------------------------------------------------------


class Runaway(Trouble):
    """A drive turns with a torque of its own, Nm, whatever it is told, for as long as it is on."""

    def __init__(self, arm: SimArm, axis: int, torque: float) -> None:
        self._arm = arm
        self._axis = axis
        self._torque = torque

    def on_plant(self) -> None:
        if self._arm.enabled:
            self.acted += 1
            self._arm.plant.drive(self._axis, 0.0, 0.0, 0.0, 0.0, self._torque)


class Weak(Trouble):
    """A drive applies a part of the torque that it should; with a negative part, in the wrong direction."""

    def __init__(self, arm: SimArm, axis: int, part: float) -> None:
        self._arm = arm
        self._axis = axis
        self._part = part
        self._command: Command | None = None

    def on_write(self, command: Command) -> Command | Sent:
        self._command = command
        return command

    def on_plant(self) -> None:
        command, axis, part = self._command, self._axis, self._part
        if command is None or not self._arm.enabled:
            return
        self.acted += 1
        kp, kd = (gain[axis] for gain in self._arm.gains)
        if command.mode is not CommandMode.TRACK:
            kp, kd = 0.0, kd if command.mode is CommandMode.DAMP else 0.0
        position, effort = command.position[axis], command.effort[axis]
        velocity = command.velocity[axis] if command.mode is CommandMode.TRACK else 0.0
        if part < 0.0:  # MuJoCo's implicit step takes no negative damping
            state = self._arm.plant.axis(axis)
            effort += kp * (position - state.position) + kd * (velocity - state.velocity)
            kp = kd = 0.0
        self._arm.plant.drive(axis, part * kp, part * kd, position, velocity, part * effort)
