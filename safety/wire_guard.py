"""The guard's own reading of DAMIAO frames: what kind of message a frame is, and what motion it asks of which joint."""

import math
from collections.abc import Iterator, Sequence

from robotctl.hal.can.bus_ids import tag, untag
from robotctl.hal.can.damiao.codec import (
    BROADCAST_ID,
    KD_MAX,
    KP_MAX,
    Offset,
    RegisterCommand,
    Special,
    decode_pos_force,
)
from robotctl.hal.can.damiao.motors import MOTORS
from robotctl.hal.can.damiao.registers import Register
from robotctl.hal.profile import DamiaoDrive, GripperProfile, RobotProfile
from robotctl.safety.asked import Asked, Kind, Move, Step, stranger

_SPECIALS: dict[int, Kind] = {
    Special.ENABLE: Kind.ENABLE,
    Special.DISABLE: Kind.DISABLE,
    Special.CLEAR_ERROR: Kind.CLEAR,
    Special.SET_ZERO: Kind.ZERO,
}
_PREFIX = b"\xff" * 7
_HALF = 0.5005
"""Half a step, and what floating point adds."""


class WireJoint:
    """One motor of the arm: its motion frames in joint coordinates."""

    def __init__(self, drive: DamiaoDrive) -> None:
        pmax, vmax, tmax = MOTORS[drive.motor]
        gear, square = drive.gear, drive.gear**2
        scale = drive.sign * gear
        self._turn = 2.0 * math.pi / gear
        # value = raw number * slope + intercept, for each field from the left
        self._position = (2.0 * pmax / 0xFFFF / scale, drive.offset - pmax / scale)
        self._velocity = (2.0 * vmax / 0xFFF / scale, -vmax / scale)
        self._kp = KP_MAX / 0xFFF * square
        self._kd = KD_MAX / 0xFFF * square
        self._effort = (2.0 * tmax / 0xFFF * scale, -tmax * scale)
        slopes = (self._position[0], self._velocity[0], self._kp, self._kd, self._effort[0])
        self.step = Step(*(_HALF * abs(slope) for slope in slopes))

    def asked(self, data: bytes, measured: float) -> Asked:
        """Return what a motion frame asks. Of the turns that a single-turn encoder leaves open, the measured one."""
        word = int.from_bytes(data, "big")
        slope, intercept = self._position
        position = (word >> 48) * slope + intercept
        if abs(measured - position) > 0.5 * self._turn:
            position += math.copysign(self._turn, measured - position)
        slope, intercept = self._velocity
        velocity = (word >> 36 & 0xFFF) * slope + intercept
        slope, intercept = self._effort
        effort = (word & 0xFFF) * slope + intercept
        return Asked.of(position, velocity, (word >> 24 & 0xFFF) * self._kp, (word >> 12 & 0xFFF) * self._kd, effort)


class WireGripper:
    """The gripper's motor, in POS_FORCE mode."""

    def __init__(self, gripper: GripperProfile, drive: DamiaoDrive) -> None:
        self.id = tag(drive.bus, drive.id + Offset.POS_FORCE)
        per_metre = abs(gripper.motor_open) / gripper.width
        self._least, self._most = sorted((0.0, gripper.motor_open))
        self._speed = gripper.speed * per_metre
        self._current = min(gripper.force / per_metre / MOTORS[drive.motor].tmax, 1.0)

    def fits(self, data: bytes) -> bool:
        """Return whether a frame stays within the stroke, the speed and the force of the profile."""
        angle, speed, current = decode_pos_force(data)
        slack = 0.01 * (self._most - self._least)
        # Fingers that stand a little outside their stroke are held where they are.
        inside = self._least - 5.0 * slack <= angle <= self._most + 5.0 * slack
        return inside and speed <= self._speed + slack and current <= self._current + 1e-3


class WireGuard:
    """Tells the kinds of all messages to an arm's DAMIAO drives, with a list for each bus: see `hal.can.bus_ids`."""

    def __init__(self, profile: RobotProfile) -> None:
        drives = [joint.drive for joint in profile.joints if isinstance(joint.drive, DamiaoDrive)]
        self.joints = [WireJoint(drive) for drive in drives]
        self._index = {tag(drive.bus, drive.id): index for index, drive in enumerate(drives)}
        self._motors = set(self._index)
        self._gripper: WireGripper | None = None
        if profile.gripper and isinstance(profile.gripper.drive, DamiaoDrive):
            drive = profile.gripper.drive
            self._motors.add(tag(drive.bus, drive.id))
            self._gripper = WireGripper(profile.gripper, drive)

    def read(
        self, frames: Sequence[tuple[int, bytes]], measured: Sequence[tuple[float, float]]
    ) -> Iterator[Kind | Move | str]:
        """Return what frames that leave together ask for; a text for one that is not on the list."""
        for arbitration_id, data in frames:
            kind = self.kind(arbitration_id, data)
            if isinstance(kind, int):
                joint = self.joints[kind]
                yield Move(kind, joint.asked(data, measured[kind][0]), joint.step)
            else:
                yield kind or stranger(arbitration_id, data)

    def kind(self, arbitration_id: int, data: bytes) -> Kind | int | None:
        """Return what a frame is: the index of the joint that it moves, its kind, or None for a stranger."""
        if len(data) != 8:
            return None
        if arbitration_id in self._motors:
            if data[:7] == _PREFIX:
                return _SPECIALS.get(data[7])
            return self._index.get(arbitration_id)
        if self._gripper is not None and arbitration_id == self._gripper.id:
            return Kind.GRIP if self._gripper.fits(data) else None
        bus, wire_id = untag(arbitration_id)
        if wire_id == BROADCAST_ID and tag(bus, int.from_bytes(data[:2], "little")) in self._motors:
            return _register_kind(data[2], data[3])
        return None


def _register_kind(command: int, register: int) -> Kind:
    if command in (RegisterCommand.READ, RegisterCommand.REFRESH):
        return Kind.READ
    return Kind.MODE if (command, register) == (RegisterCommand.WRITE, Register.CTRL_MODE) else Kind.STORE
